"""One way to find a photograph by the name that a file of poses has."""

import unicodedata
from pathlib import Path

import pytest

from compgs.scene.names import Names, matches, without_suffix


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.png", "cam 0/b (1).JPG", "cam 0/frame.0001.png", "both.png", "both.jpg", "x/é.png"):
        path = tmp_path / unicodedata.normalize("NFD", name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("a.png", "a.png"),
        ("./a.png", "a.png"),
        ("a", "a.png"),
        ("A.PNG", "a.png"),
        ("cam 0\\b (1).JPG", "cam 0/b (1).JPG"),
        (".\\cam 0\\b (1).jpg", "cam 0/b (1).JPG"),
        ("Cam 0/b (1)", "cam 0/b (1).JPG"),
        ("cam 0/frame.0001", "cam 0/frame.0001.png"),
        ("both", "both.png"),
        ("both.jpg", "both.jpg"),
        ("cam 0/b (1).png", "cam 0/b (1).JPG"),
        (unicodedata.normalize("NFC", "x/é.png"), unicodedata.normalize("NFD", "x/é.png")),
        (unicodedata.normalize("NFC", "X/É"), unicodedata.normalize("NFD", "x/é.png")),
    ],
)
def test_names_of_other_programs_mean_the_file_that_is_there(folder: Path, name: str, found: str) -> None:
    assert Names().find(folder, name) == folder / found


@pytest.mark.parametrize(
    "name", ["b.png", "cam 0/frame.0002.png", "cam 0/frame.0002", "cam 0", "", ".", "x/../a", "../a", "/a"]
)
def test_other_names_mean_none(folder: Path, name: str) -> None:
    assert Names().find(folder / "x" if name == "../a" else folder, name) is None


def test_the_file_that_is_spelled_so_goes_before_one_in_other_letter_case(tmp_path: Path) -> None:
    for name in ("a.png", "A.png"):
        (tmp_path / name).touch()
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this file system does not tell letter case apart")
    assert [Names().find(tmp_path, name) for name in ("a.png", "A.png")] == [
        tmp_path / "a.png",
        tmp_path / "A.png",
    ]
    for name in ("b.x", "B.x"):
        (tmp_path / name).touch()
    assert Names().find(tmp_path, "b.X") is None  # of two, none is meant


def test_lists_of_names_are_read_as_tolerantly() -> None:
    names = ["cam0/é.png", "cam0/r_1", "c.jpg", "frame.0001", "frame.0002"]
    listed = [
        "cam0\\é.png",
        unicodedata.normalize("NFD", "cam0/é"),
        "cam0/r_1.png",
        "C.JPG",
        "frame.0001",
        "d.png",
    ]
    assert list(matches(listed, names).items()) == [
        (listed[0], names[0]),
        (listed[1], names[0]),
        (listed[2], names[1]),
        (listed[3], names[2]),
        (listed[4], names[3]),
    ]


def test_only_suffixes_of_images_are_suffixes() -> None:
    assert [without_suffix(name) for name in ("a/b.JPG", "frame.0001", "c", "v1.2/d")] == [
        "a/b",
        "frame.0001",
        "c",
        "v1.2/d",
    ]
