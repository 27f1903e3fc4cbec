"""One HTML page that opens anywhere: style and script stand in it, pictures are data URLs, nothing is fetched."""

import functools
import html
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

# A browser that knows it fetches nothing for the page, whatever its text may hold.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
WIDEST = 2.0  # pixels of the screen that a pixel of a picture may take


def page(title: str, body: str) -> bytes:
    """UTF-8 of a page. `title`: any text; `body`: HTML."""
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>
{_part("page.css")}</style>
</head>
<body>
<h1>{html.escape(title)}</h1>
{body}<script>
{_part("page.js")}</script>
</body>
</html>
""".encode("utf-8", "replace")


@dataclass(frozen=True)
class Picture:
    """One of a stack."""

    label: str
    url: str
    errors: str | None = None  # URL of a picture of its errors, which stands beside it


def slider(
    pictures: Sequence[Picture], width: int, height: int, caption: str, left: int = 0, right: int = 1
) -> str:
    """Two of some pictures [height, width] on each other with a line between them; which two, the reader chooses.

    Beside them stands the picture of the errors of the one on the right, or of the one on the left, or of the first
    that has one. `caption`: text below. `left`, `right`: indices of the pictures that are seen first.
    """
    stack = "".join(
        f'<img class="{" ".join(_sides(i, left, right))}" alt="{html.escape(each.label)}" src="{each.url}">\n'
        for i, each in enumerate(pictures)
    )
    errors = "".join(
        f'<img data-of="{i}" alt="errors of {html.escape(each.label)}" src="{each.errors}">\n'
        for i, each in enumerate(pictures)
        if each.errors
    )
    lists = "".join(
        f'<select class="{side}" aria-label="picture on the {side}">{_options(pictures, chosen)}</select>'
        for side, chosen in (("left", left), ("right", right))
    )
    shape = f'style="aspect-ratio:{width}/{height};max-width:{WIDEST * width:g}px"'
    beside = f'<div class="beside" {shape}>\n{errors}</div>\n' if errors else ""
    return (
        f'<figure class="compare">\n<div class="stages">\n<div class="stage" {shape}>\n{stack}'
        '<div class="handle" role="slider" tabindex="0" aria-label="line between the pictures" '
        'aria-valuemin="0" aria-valuemax="100" aria-valuenow="50"></div>\n</div>\n'
        f'{beside}</div>\n<div class="choice">{lists}</div>\n'
        f"<figcaption>{html.escape(caption)}</figcaption>\n</figure>\n"
    )


def heading(text: str, level: int = 2) -> str:
    return f"<h{level}>{html.escape(text)}</h{level}>\n"


def paragraph(text: str, kind: str = "") -> str:
    return f'<p class="{kind}">{html.escape(text)}</p>\n' if kind else f"<p>{html.escape(text)}</p>\n"


def folded(summary: str, body: str) -> str:
    """HTML that is seen after a click."""
    return f"<details><summary>{html.escape(summary)}</summary>\n{body}</details>\n"


def side_by_side(parts: Sequence[str]) -> str:
    return '<div class="row">' + "".join(f"<div>{part}</div>\n" for part in parts) + "</div>\n"


def _sides(index: int, left: int, right: int) -> list[str]:
    return [side for side, chosen in (("left", left), ("right", right)) if chosen == index]


def _options(pictures: Sequence[Picture], chosen: int) -> str:
    return "".join(
        f"<option{' selected' if i == chosen else ''}>{html.escape(each.label)}</option>"
        for i, each in enumerate(pictures)
    )


@functools.cache
def _part(name: str) -> str:
    return files("compgs.evaluation.reports").joinpath(name).read_text("utf-8")
