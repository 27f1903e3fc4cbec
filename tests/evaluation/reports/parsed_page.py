"""What a test asks of a page: its tables, its pictures, and whether it asks anything of the network."""

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
from PIL import Image

FETCHING = ("src", "href", "srcset", "data", "poster", "action", "xlink:href")


class ParsedPage(HTMLParser):
    """Tables by their id, as rows of cells; images by their alternative text; addresses; all text."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.images: list[tuple[str, str]] = []  # alternative text, address
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self._rows: list[list[str]] | None = None
        self._cell = False
        self._raw = page.decode("utf-8")
        self.feed(self._raw)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        self.addresses += [value for name, value in values.items() if name in FETCHING]
        if tag == "img":
            self.images.append((values["alt"], values["src"]))
        if tag == "table":
            self._rows = self.tables[values["id"]] = []
        if tag == "tr" and self._rows is not None:
            self._rows.append([])
        if tag in ("td", "th") and self._rows is not None:
            self._rows[-1].append("")
            self._cell = True

    def handle_endtag(self, tag: str) -> None:
        self._cell = self._cell and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._cell and self._rows is not None:
            self._rows[-1][-1] += data

    def row(self, table: str, first: str) -> dict[str, str]:
        """Cells of the row that begins with a word, by their headings."""
        head, *rows = self.tables[table]
        found = next(row for row in rows if row[0] == first)
        return dict(zip(head, found, strict=True))

    def asks_nothing_of_the_network(self) -> bool:
        """No address but data URLs and places in the page, no import or address in style or script."""
        elsewhere = [a for a in self.addresses if not a.startswith(("data:", "#"))]
        fetched = re.search(
            r"@import|url\((?!data:)|https?://|//\w+\.\w+/|fetch\(|XMLHttpRequest|<link", self._raw
        )
        return not elsewhere and fetched is None


def picture_of(url: str) -> np.ndarray:
    """[H, W, 3] uint8 of a data URL."""
    data = base64.b64decode(url.partition("base64,")[2], validate=True)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
