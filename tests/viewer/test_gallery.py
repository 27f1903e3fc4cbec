"""The gallery's server: its list, whole files and parts of them, and nothing from outside of the folder."""

import html
import http.client
import io
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import compgs
from compgs.formats.tiled_writer import NewTile, write_tiles
from compgs.metrics import psnr, to_8bit
from compgs.viewer.gallery import byte_range, gallery_page, gallery_server
from compgs.viewer.thumbnails import Thumbnails
from compgs.words import short_size

DATA = bytes(range(256)) * 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "scenes"
    (folder / "inner").mkdir(parents=True)
    (folder / "inner" / "a b&<i>.cgs").write_bytes(DATA)
    (folder / "notes.txt").write_text("private")
    (tmp_path / "outside.cgs").write_bytes(b"outside")
    (folder / "link.cgs").symlink_to(tmp_path / "outside.cgs")
    return folder


@pytest.fixture
def address(folder: Path) -> Iterator[tuple[str, int]]:
    with gallery_server(folder, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield "127.0.0.1", server.server_port
        server.shutdown()
        thread.join()


def ask(
    address: tuple[str, int], path: str, method: str = "GET", **headers: str
) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection(*address, timeout=30)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


GOLDEN = Path(__file__).parent.parent / "golden" / "trained.cgs"


def test_the_list_links_every_whole_file_and_nothing_else(folder: Path) -> None:
    (folder / "inner" / "a b&<i>.cgs").write_bytes(GOLDEN.read_bytes())
    page = gallery_page(folder.resolve(), Thumbnails()).decode()
    assert page.count("<li>") == 1
    assert "inner/a b&amp;&lt;i&gt;" in page and "6.18 kB" in page
    assert 'href="/view?url=%2Ffiles%2Finner%2Fa%2520b%2526%253Ci%253E.cgs"' in page


def test_a_file_that_is_not_whole_is_marked_says_why_and_has_no_link(folder: Path) -> None:
    (folder / "cut.cgs").write_bytes(GOLDEN.read_bytes()[:300])
    page = gallery_page(folder.resolve(), Thumbnails()).decode()
    assert page.count("<li>") == page.count('class="card broken"') == 2
    assert "header promises" in page and "href=" not in page.partition("<h1>")[2]
    (folder / "cut.cgs").write_bytes(GOLDEN.read_bytes())  # copied again
    assert "href=" in gallery_page(folder.resolve(), Thumbnails()).decode().partition("<h1>")[2]


def test_thumbnails_show_what_the_page_shows_first(address: tuple[str, int], folder: Path) -> None:
    (folder / "scene.cgs").write_bytes(GOLDEN.read_bytes())
    status, headers, body = ask(address, "/thumbnails/scene.cgs?1")
    assert status == 200 and headers["Content-Type"] == "image/jpeg"
    picture = np.asarray(Image.open(io.BytesIO(body)))
    assert picture.shape == (240, 320, 3)
    model = compgs.decode(GOLDEN)
    shares = []
    for camera in model.viewpoints:
        x, y, depth = camera.rotation @ model.bounds[0].T + camera.translation[:, None]
        u, v = camera.fx * x / depth / camera.width, camera.fy * y / depth / camera.height
        inside = (depth > 0) & (abs(u) < 0.48) & (abs(v) < 0.48)
        shares.append(inside.mean())
    ahead = np.stack([camera.rotation[2] for camera in model.viewpoints])
    as_all = np.where(np.array(shares) > 0.8 * max(shares), ahead @ ahead.sum(axis=0), -len(ahead))
    expected = compgs.render(model, model.viewpoints[int(np.argmax(as_all))].resized(320, 240)).image
    assert psnr(picture, to_8bit(expected)) > 30


def test_thumbnails_of_what_is_no_scene_or_outside_are_not_found(address: tuple[str, int]) -> None:
    for path in ("inner/a%20b%26%3Ci%3E.cgs", "link.cgs", "notes.txt", "../outside.cgs", "nothing.cgs", ""):
        assert ask(address, f"/thumbnails/{path}")[0] == 404


def test_a_scenes_page_has_its_name_and_a_way_back(address: tuple[str, int]) -> None:
    body = ask(address, "/view?url=%2Ffiles%2Finner%2Fa%2520%253Cb%253E.cgs")[2].decode()
    assert "<title>inner/a &lt;b&gt;</title>" in body
    assert body.count("</body>") == 1 and '<a href="/"' in body.rpartition("</script>")[2]


def test_a_scene_of_tiles_is_one_in_the_list_and_its_files_are_served(
    address: tuple[str, int], folder: Path
) -> None:
    write_tiles(folder / "town.tiles", [NewTile(name, GOLDEN.read_bytes()) for name in ("a", "b")])
    page = gallery_page(folder.resolve(), Thumbnails()).decode()
    assert page.count('<span class="name">town</span>') == 1 and "town.tiles/a" not in page
    assert 'href="/view?url=%2Ffiles%2Ftown.tiles%2Fmanifest.json"' in page
    size = sum(file.stat().st_size for file in (folder / "town.tiles").iterdir())
    assert short_size(size) in page
    status, headers, body = ask(address, "/files/town.tiles/manifest.json")
    assert (status, headers["Content-Type"]) == (200, "application/json")
    assert body == (folder / "town.tiles" / "manifest.json").read_bytes()
    assert ask(address, "/files/town.tiles/a.cgs", Range="bytes=5-9")[2] == GOLDEN.read_bytes()[5:10]
    assert ask(address, "/thumbnails/town.tiles/manifest.json")[0] == 200
    view = ask(address, "/view?url=%2Ffiles%2Ftown.tiles%2Fmanifest.json")[2].decode()
    assert "<title>town</title>" in view


def test_another_manifest_is_not_served(address: tuple[str, int], folder: Path) -> None:
    (folder / "manifest.json").write_text('{"password": "secret"}')
    assert ask(address, "/files/manifest.json")[0] == 404
    assert "manifest" not in gallery_page(folder.resolve(), Thumbnails()).decode()


def test_an_empty_folder_says_how_a_file_gets_there(tmp_path: Path) -> None:
    page = gallery_page(tmp_path, Thumbnails()).decode()
    assert "There is no .cgs file" in page and "compgs train SCENE -o " in page
    (tmp_path / "my splats.ply").write_bytes(b"")
    page = html.unescape(gallery_page(tmp_path, Thumbnails()).decode())
    assert f"compgs compress '{tmp_path}/my splats.ply' -o '{tmp_path}/my splats.cgs'" in page


def test_list_and_viewer_are_pages(address: tuple[str, int]) -> None:
    for path in ("/", "/view?url=%2Ffiles%2Fx.cgs"):
        status, headers, body = ask(address, path)
        assert status == 200 and headers["Content-Type"] == "text/html; charset=utf-8"
        assert body.startswith(b"<!doctype html>")


def test_a_file_is_served_whole_and_in_parts(address: tuple[str, int]) -> None:
    path = "/files/inner/a%20b%26%3Ci%3E.cgs"
    status, headers, body = ask(address, path)
    assert (status, body, headers["Accept-Ranges"]) == (200, DATA, "bytes")
    assert headers["Content-Type"] == "model/vnd.compgs"
    status, headers, body = ask(address, path, Range="bytes=10-19")
    assert (status, body, headers["Content-Range"]) == (206, DATA[10:20], "bytes 10-19/2048")
    assert ask(address, path, Range="bytes=2040-")[2] == DATA[2040:]
    assert ask(address, path, Range="bytes=-5")[2] == DATA[-5:]
    status, headers, body = ask(address, path, Range="bytes=2048-")
    assert (status, body, headers["Content-Range"]) == (416, b"", "bytes */2048")
    status, headers, body = ask(address, path, "HEAD")
    assert (status, body, headers["Content-Length"]) == (200, b"", "2048")


@pytest.mark.parametrize(
    "path",
    [
        "/files/../outside.cgs",
        "/files/%2e%2e/outside.cgs",
        "/files/inner/../../outside.cgs",
        "/files/link.cgs",
        "/files/notes.txt",
        "/files/inner",
        "/files/missing.cgs",
        "/files/%00.cgs",
        "/files//etc/hostname",
        "/notes.txt",
    ],
)
def test_nothing_but_the_folders_scenes_is_served(address: tuple[str, int], path: str) -> None:
    assert ask(address, path)[0] == 404


def test_an_absolute_path_stays_in_the_folder(address: tuple[str, int], folder: Path) -> None:
    assert ask(address, f"/files/{folder.parent / 'outside.cgs'}")[0] == 404
    assert ask(address, f"/files/%2F{str(folder.parent / 'outside.cgs').lstrip('/')}")[0] == 404


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (None, range(100)),
        ("bytes=0-0", range(1)),
        ("bytes=5-", range(5, 100)),
        ("bytes=90-200", range(90, 100)),
        ("bytes=-300", range(100)),
        ("bytes=100-", None),
        ("bytes=-0", None),
        ("bytes=5-4", range(100)),
        ("bytes=1-2,4-5", range(100)),
        ("bytes=x-4", range(100)),
        ("bytes=-", range(100)),
        ("items=0-1", range(100)),
    ],
)
def test_ranges_are_read_as_the_standard_has_them(header: str | None, expected: range | None) -> None:
    assert byte_range(header, 100) == expected
