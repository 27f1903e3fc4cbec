"""The gallery's server: its list, whole files and parts of them, and nothing from outside of the folder."""

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from compgs.viewer.gallery import byte_range, gallery_page, gallery_server

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


def test_the_list_links_every_file_and_nothing_else(folder: Path) -> None:
    page = gallery_page(folder.resolve()).decode()
    assert page.count("<li>") == 1
    assert "inner/a b&amp;&lt;i&gt;" in page and "2 kB" in page
    assert 'href="/view?url=%2Ffiles%2Finner%2Fa%2520b%2526%253Ci%253E.cgs"' in page


def test_an_empty_folder_says_so(tmp_path: Path) -> None:
    assert b"There is no .cgs file" in gallery_page(tmp_path)


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
