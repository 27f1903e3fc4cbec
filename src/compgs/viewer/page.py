"""One HTML page with everything in it: a .cgs file, the decoder and the viewer of web/.

page.html is built from web/ (`make web`). The page asks nothing of the network: it works from a disk, in a mail, on any
server.
"""

import base64
import functools
import html
from importlib.resources import files


def html_page(data: bytes, title: str) -> bytes:
    """UTF-8 of a page that shows a scene.

    `data`: a .cgs file, which is not decoded here; the page says what is wrong with one that is damaged. Without bytes
    the page shows the file that its address names (`?url=`), or one that is dropped onto it. `title`: any text.
    """
    before, between, after = _template()
    parts = (before, html.escape(title), between, base64.b64encode(data).decode("ascii"), after)
    return "".join(parts).encode()


@functools.cache
def _template() -> tuple[str, str, str]:
    """What stands before the title, between title and data, and behind them."""
    page = files("compgs.viewer").joinpath("page.html").read_text("utf-8")
    before, rest = page.split("{{title}}", 1)
    between, after = rest.split("{{data}}", 1)
    return before, between, after
