"""A web server for a folder of .cgs files: a list of them, the page that shows one, and their bytes.

Only .cgs files within the folder are served, nothing else of the machine; links that lead out of it are not followed.
"""

import html
from collections.abc import Iterator
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from compgs.viewer.page import html_page

SUFFIX, MEDIA_TYPE = ".cgs", "model/vnd.compgs"  # docs/bitstream.md, "Promise"
FILES = "/files/"
VIEW = "/view"
COPIED_BYTES = 1 << 20  # of a file, in memory at a time

GALLERY = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>
  :root {{ color-scheme: dark; font: 16px/1.5 system-ui, sans-serif; }}
  body {{ margin: 2rem auto; max-width: 50rem; padding: 0 1rem; background: #111; color: #eee; }}
  ul {{ list-style: none; padding: 0; }}
  a {{ display: flex; justify-content: space-between; gap: 1rem; padding: .6rem 1rem; margin: .4rem 0; color: inherit;
    text-decoration: none; background: #1c1c1e; border: 1px solid #fff3; border-radius: 8px; }}
  a:hover {{ background: #2c2c30; }}
  span:first-child {{ overflow-wrap: anywhere; }}
  span + span {{ color: #999; white-space: nowrap; }}
</style>
</head>
<body>
<h1>{title}</h1>
<ul>
{items}
</ul>
</body>
</html>
"""


def gallery_server(folder: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of the .cgs files in `folder` and below, bound and not yet running; port 0 takes a free one.

    Raises OSError if the address cannot be used.
    """
    return ThreadingHTTPServer((host, port), partial(GalleryHandler, folder.resolve()))


def scene_files(folder: Path) -> list[Path]:
    """The .cgs files in a folder and below, by name; those that links lead out of it to are not among them."""
    return sorted(path for path in folder.rglob(f"*{SUFFIX}") if _is_served(path, folder))


def gallery_page(folder: Path) -> bytes:
    """UTF-8 of the list."""
    items = "\n".join(_items(folder)) or f"<li>There is no {SUFFIX} file in this folder.</li>"
    return GALLERY.format(title=html.escape(folder.name or "scenes"), items=items).encode()


def _items(folder: Path) -> Iterator[str]:
    for path in scene_files(folder):
        relative = path.relative_to(folder).as_posix()
        address = f"{VIEW}?url={quote(FILES + quote(relative), safe='')}"
        kilobytes = max(1, round(path.stat().st_size / 1000))
        name = html.escape(relative.removesuffix(SUFFIX))
        yield f'<li><a href="{address}"><span>{name}</span><span>{kilobytes:,} kB</span></a></li>'


def _is_served(path: Path, folder: Path) -> bool:
    """Whether it is a .cgs file that lies, links followed, in the folder."""
    try:
        return path.suffix == SUFFIX and path.is_file() and path.resolve().is_relative_to(folder)
    except (OSError, ValueError):  # names that no file can have
        return False


class GalleryHandler(BaseHTTPRequestHandler):
    """One request. `folder` is resolved."""

    server_version = "compgs"
    sys_version = ""

    def __init__(self, folder: Path, *arguments: object) -> None:
        self.folder = folder
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        if path == "/":
            self._answer(gallery_page(self.folder))
        elif path == VIEW:
            self._answer(html_page(b"", "compgs"))
        elif path.startswith(FILES):
            self._answer_file(self.folder / unquote(path.removeprefix(FILES)).lstrip("/"))
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _answer(self, page: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(page)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(page)

    def _answer_file(self, path: Path) -> None:
        if not _is_served(path, self.folder):
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with path.open("rb") as file:
            size = path.stat().st_size
            wanted = byte_range(self.headers.get("Range"), size)
            if wanted is None:
                self.send_response(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                self.send_header("Content-Range", f"bytes */{size}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            is_part = len(wanted) != size
            self.send_response(HTTPStatus.PARTIAL_CONTENT if is_part else HTTPStatus.OK)
            if is_part:
                self.send_header("Content-Range", f"bytes {wanted.start}-{wanted.stop - 1}/{size}")
            self.send_header("Content-Type", MEDIA_TYPE)
            self.send_header("Accept-Ranges", "bytes")
            self.send_header("Content-Length", str(len(wanted)))
            self.end_headers()
            if self.command == "HEAD":
                return
            file.seek(wanted.start)
            left = len(wanted)
            while left and (piece := file.read(min(left, COPIED_BYTES))):
                self.wfile.write(piece)
                left -= len(piece)

    def log_message(self, format: str, *arguments: object) -> None:
        """Requests are not written down."""


def byte_range(header: str | None, size: int) -> range | None:
    """Bytes that a Range header asks for: all of them without one, or with one that is not understood (RFC 9110, 14.2);
    None if it asks for bytes that are not there. Of several ranges all bytes are sent.
    """
    unit, _, spec = (header or "").partition("=")
    first, dash, last = (part.strip() for part in spec.partition("-"))
    known = unit.strip() == "bytes" and dash and "," not in spec
    if not known or not all(
        (part.isascii() and part.isdigit() and len(part) < 20) or not part for part in (first, last)
    ):
        return range(size)
    if first:
        start, stop = int(first), min(int(last) + 1, size) if last else size
        if last and int(last) < int(first):
            return range(size)
    elif last:  # so many of the last ones
        start, stop = max(0, size - int(last)), size
    else:
        return range(size)
    return range(start, stop) if start < stop else None
