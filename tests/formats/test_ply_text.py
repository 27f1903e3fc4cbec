"""A .ply of text holds the numbers that stand in it."""

from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import SplatArrays, encoded, ply_text, read_ply
from compgs.formats.ply import property_groups
from compgs.opening import check_scene, component_bytes, format_of, open_scene

from .foreign import text_ply

CASE = Path(__file__).parents[3] / "shared" / "cases" / "ply_ascii" / "scene.ply"


@pytest.fixture
def binary(made, tmp_path: Path) -> Path:
    path = tmp_path / "binary.ply"
    path.write_bytes(encoded(made(9, 2), "ply"))
    return path


@pytest.fixture
def text(binary: Path, tmp_path: Path) -> Path:
    path = tmp_path / "text.ply"
    path.write_bytes(text_ply(binary.read_bytes()))
    return path


def same(one: SplatArrays, other: SplatArrays) -> None:
    for name, values in vars(one).items():
        assert np.array_equal(values, getattr(other, name)), name


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_text_is_read_as_the_numbers_that_it_shows(binary: Path, text: Path, end: str) -> None:
    text.write_bytes(text_ply(binary.read_bytes(), end=end))
    check_scene(text)
    same(ply_text.read(text), read_ply(binary))
    same(open_scene(text).splats, read_ply(binary))
    assert sum(component_bytes(text).values()) == text.stat().st_size


def test_numbers_may_be_cut_by_the_ends_of_the_blocks_that_are_read(
    binary: Path, text: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for block in (32, 33, 64):
        monkeypatch.setattr(ply_text, "_BLOCK", block)
        same(ply_text.read(text), read_ply(binary))
    monkeypatch.setattr(ply_text, "_BLOCK", 1)
    with pytest.raises(SplatFileError, match="is not text"):  # no number is longer than a block
        ply_text.read(text)


def test_rows_of_other_elements_are_passed_over(binary: Path, text: Path) -> None:
    data = text.read_bytes().replace(
        b"end_header", b"element face 1\nproperty list uchar int ids\nend_header"
    )
    text.write_bytes(data + b"3 0 1 2\n")
    same(ply_text.read(text), read_ply(binary))
    first = text_ply(binary.read_bytes())
    first = first.replace(b"element vertex", b"element camera 2\nproperty float f\nelement vertex")
    text.write_bytes(first.replace(b"end_header\n", b"end_header\n0.5\n0.25\n"))
    same(ply_text.read(text), read_ply(binary))


@pytest.mark.skipif(not CASE.is_file(), reason=f"no {CASE}")
def test_a_file_of_another_program_is_read() -> None:
    assert format_of(CASE).name == "ply"
    splats = ply_text.read(CASE)
    names = [name for group in property_groups(1).values() for name in group]
    rows = [line.split() for line in CASE.read_text().partition("end_header\n")[2].splitlines()]
    column = {name: np.array([float(row[i]) for row in rows], np.float32) for i, name in enumerate(names)}
    assert len(splats) == len(rows) == 24
    assert np.array_equal(splats.means[:, 1], column["y"])
    assert np.array_equal(splats.rest[:, 2, 1], column["f_rest_5"])  # green, third harmonic
    assert np.array_equal(splats.quaternions[:, 0], column["rot_0"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"vertex 9", b"vertex 999999999", "at least .* bytes of text"),
        (b"vertex 9", b"vertex 30", r"ends after 369 of 1230 numbers"),
        (b"vertex 9", b"vertex 0", "holds no splats"),
        (b"property float opacity\n", b"", "'opacity' is missing"),
        (b"property float opacity", b"property list uchar int opacity", "not a property"),
    ],
)
def test_a_header_that_promises_something_else_is_refused(
    text: Path, old: bytes, new: bytes, message: str
) -> None:
    text.write_bytes(text.read_bytes().replace(old, new))
    with pytest.raises(SplatFileError, match=message) as caught:
        ply_text.read(text)
    assert str(text) in str(caught.value)


def test_what_is_no_number_is_named_by_its_splat_and_property(text: Path) -> None:
    header, _, body = text.read_bytes().partition(b"end_header\n")
    rows = body.split(b"\n")
    third = rows[2].split()
    third[1] = b"1,5"
    rows[2] = b" ".join(third)
    text.write_bytes(header + b"end_header\n" + b"\n".join(rows))
    with pytest.raises(SplatFileError, match="y of splat 2 is '1,5', expected a number"):
        ply_text.read(text)
