"""A web server for a folder of .cgs files: a list of them with pictures, the page that shows one, and their bytes.

A scene of tiles is one in the list; the page fetches its manifest and, of its tiles, what is looked at.

Only .cgs files and manifests of tiles within the folder are served, nothing else of the machine; links that lead out of
it are not followed.
"""

import html
import shlex
from collections.abc import Iterator
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, quote, unquote, urlsplit

from compgs.formats import tiled
from compgs.viewer.page import html_page
from compgs.viewer.thumbnails import Thumbnails
from compgs.words import short_size

SUFFIX, MEDIA_TYPE = ".cgs", "model/vnd.compgs"  # docs/bitstream.md, "Promise"
SPLATS = (".ply", ".spz", ".sog", ".splat", ".glb")  # what `compgs compress` takes
FILES = "/files/"
THUMBNAILS = "/thumbnails/"
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
  body {{ margin: 2rem auto; max-width: 70rem; padding: 0 1rem; background: #111; color: #eee; }}
  ul {{ list-style: none; padding: 0; display: grid; gap: 1rem;
    grid-template-columns: repeat(auto-fill, minmax(min(15rem, 100%), 1fr)); }}
  .card {{ display: block; height: 100%; color: inherit; text-decoration: none; background: #1c1c1e;
    border: 1px solid #fff3; border-radius: 8px; overflow: hidden; }}
  a.card:hover, a.card:focus-visible {{ background: #2c2c30; border-color: #6cf; }}
  .picture {{ display: grid; place-items: center; width: 100%; height: auto;
    aspect-ratio: 4 / 3; object-fit: cover; background: #26262a; color: #999; }}
  .words {{ display: flex; justify-content: space-between; gap: 1rem; padding: .5rem .8rem; }}
  .name {{ overflow-wrap: anywhere; }}
  .size {{ color: #999; white-space: nowrap; }}
  .broken {{ border-color: #d66; }}
  .trouble {{ display: block; padding: 0 .8rem .6rem; color: #f99; font-size: .85rem; overflow-wrap: anywhere; }}
  code {{ background: #26262a; border-radius: 4px; padding: .1rem .4rem; overflow-wrap: anywhere; }}
</style>
</head>
<body>
<h1>{title}</h1>
{content}
</body>
</html>
"""

CARD = """<li><a class="card" href="{address}">
<img class="picture" src="{picture}" alt="" loading="lazy" width="320" height="240">
<span class="words"><span class="name">{name}</span><span class="size">{size}</span></span></a></li>"""

BROKEN = """<li><span class="card broken">
<span class="picture">no picture</span>
<span class="words"><span class="name">{name}</span><span class="size">{size}</span></span>
<span class="trouble">{trouble}</span></span></li>"""

EMPTY = """<p>There is no .cgs file in this folder.</p>
<p>{make}: <code>{command}</code></p>
<p>Then load this page again.</p>"""

# The way back from a scene, above all that the page has.
WAY_BACK = b"""<a href="/" style="position: fixed; left: 12px; top: 12px; z-index: 9; padding: 4px 10px; color: #eee;
  background: #0009; border: 1px solid #fff4; border-radius: 6px; font: 14px/1.5 system-ui, sans-serif;
  text-decoration: none">All scenes</a>
</body>"""


def gallery_server(folder: Path, host: str, port: int) -> ThreadingHTTPServer:
    """A server of the .cgs files in `folder` and below, bound and not yet running; port 0 takes a free one.

    Raises OSError if the address cannot be used.
    """
    return ThreadingHTTPServer((host, port), partial(GalleryHandler, folder.resolve(), Thumbnails()))


def scene_files(folder: Path) -> list[Path]:
    """The .cgs files and the manifests of tiles in a folder and below, by name, without the tiles.

    Those that links lead out of it to are not among them.
    """
    manifests = {path for path in folder.rglob(tiled.MANIFEST) if _is_served(path, folder)}
    tiles = {path.parent for path in manifests}
    files = {path for path in folder.rglob(f"*{SUFFIX}") if _is_served(path, folder)}
    return sorted(manifests | {path for path in files if path.parent not in tiles})


def gallery_page(folder: Path, thumbnails: Thumbnails) -> bytes:
    """UTF-8 of the list."""
    items = "\n".join(_items(folder, thumbnails))
    content = f"<ul>\n{items}\n</ul>" if items else _hint(folder)
    return GALLERY.format(title=html.escape(folder.name or "scenes"), content=content).encode()


def scene_page(query: str) -> bytes:
    """UTF-8 of the page that shows the file which its address names (`?url=`)."""
    (address,) = parse_qs(query).get("url", ["compgs"])[:1]
    name = scene_title(unquote(address).removeprefix(FILES))
    before, end, after = html_page(b"", name).rpartition(b"</body>")
    return before + WAY_BACK + after if end else after


def scene_title(relative: str) -> str:
    """What a scene is called, by the path of its file or manifest in the folder."""
    place = relative.removesuffix(f"/{tiled.MANIFEST}")
    return place.removesuffix(SUFFIX if place == relative else tiled.SUFFIX)


def _bytes_of(path: Path) -> int:
    """Bytes of a file; of a manifest, of all its tiles, too."""
    beside = path.parent.glob(f"*{SUFFIX}") if path.name == tiled.MANIFEST else ()
    return path.stat().st_size + sum(file.stat().st_size for file in beside)


def _items(folder: Path, thumbnails: Thumbnails) -> Iterator[str]:
    for path in scene_files(folder):
        try:
            status, trouble = path.stat(), thumbnails.trouble(path)
        except OSError:  # it has gone meanwhile
            continue
        relative = path.relative_to(folder).as_posix()
        name, size = html.escape(scene_title(relative)), short_size(_bytes_of(path))
        if trouble is not None:
            yield BROKEN.format(name=name, size=size, trouble=html.escape(trouble))
            continue
        address = f"{VIEW}?url={quote(FILES + quote(relative), safe='')}"
        picture = (
            f"{THUMBNAILS}{quote(relative)}?{status.st_mtime_ns}"  # another one when the file has changed
        )
        yield CARD.format(address=address, picture=picture, name=name, size=size)


def _hint(folder: Path) -> str:
    """How a file gets into a folder that has none."""
    splats = next((path for path in sorted(folder.rglob("*")) if path.suffix.lower() in SPLATS), None)
    if splats is not None:
        target = splats.with_suffix(SUFFIX)
        make, words = "Splats become one", ["compgs", "compress", str(splats), "-o", str(target)]
    else:
        make, words = "Photographs become one", ["compgs", "train", "SCENE", "-o", str(folder / "garden")]
    return EMPTY.format(make=make, command=html.escape(shlex.join(words)))


def _is_served(path: Path, folder: Path) -> bool:
    """Whether it is a .cgs file, or a manifest of tiles, that lies, links followed, in the folder."""
    try:
        is_named = path.suffix == SUFFIX or path.name == tiled.MANIFEST
        if not (is_named and path.is_file() and path.resolve().is_relative_to(folder)):
            return False
        return path.suffix == SUFFIX or _is_manifest(path)
    except (OSError, ValueError):  # names that no file can have
        return False


def _is_manifest(path: Path) -> bool:
    with path.open("rb") as file:
        return tiled.begins(file.read(64))


class GalleryHandler(BaseHTTPRequestHandler):
    """One request. `folder` is resolved."""

    server_version = "compgs"
    sys_version = ""

    def __init__(self, folder: Path, thumbnails: Thumbnails, *arguments: object) -> None:
        self.folder = folder
        self.thumbnails = thumbnails
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        path = parts.path
        if path == "/":
            self._answer(gallery_page(self.folder, self.thumbnails))
        elif path == VIEW:
            self._answer(scene_page(parts.query))
        elif path.startswith(FILES):
            self._answer_file(self._place(path.removeprefix(FILES)))
        elif path.startswith(THUMBNAILS):
            self._answer_thumbnail(self._place(path.removeprefix(THUMBNAILS)))
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _place(self, name: str) -> Path:
        return self.folder / unquote(name).lstrip("/")

    def _answer(self, content: bytes, kind: str = "text/html; charset=utf-8", **headers: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _answer_thumbnail(self, path: Path) -> None:
        picture = self.thumbnails.picture(path) if _is_served(path, self.folder) else None
        if picture is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._answer(picture, "image/jpeg", Cache_Control="max-age=86400")

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
            kind = MEDIA_TYPE if path.suffix == SUFFIX else "application/json"
            self.send_header("Content-Type", kind)
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
