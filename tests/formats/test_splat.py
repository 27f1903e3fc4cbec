"""antimatter15's .splat: 32 bytes a splat, known by being possible."""

import struct
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import NotACompGSFile, SplatFileError
from compgs.formats import splat
from compgs.formats.arrays import Y0, normalized
from compgs.opening import format_of

ROW = struct.pack("<3f3f", 1.5, -2.0, 3.25, 0.5, 0.25, 1.0) + bytes([255, 0, 51, 102, 192, 128, 128, 239])


def test_a_file_made_by_hand_holds_the_splat_it_describes(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(ROW * 2)
    arrays = splat.read(path)
    assert len(arrays) == 2 and arrays.degree == 0
    np.testing.assert_array_equal(arrays.means[1], [1.5, -2.0, 3.25])
    np.testing.assert_allclose(np.exp(arrays.log_scales[0]), [0.5, 0.25, 1.0], rtol=1e-6)
    np.testing.assert_allclose(0.5 + Y0 * arrays.dc[0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(arrays.opacities, 0.4, atol=1e-6)
    np.testing.assert_allclose(arrays.quaternions[0], [0.5, 0, 0, 111 / 128])
    assert splat.component_bytes(path) == {
        "positions": 24,
        "scales": 24,
        "colors and opacities": 8,
        "rotations": 8,
    }


def test_flat_splats_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(ROW[:12] + struct.pack("<3f", 0.5, 0.0, 1.0) + ROW[24:])
    assert np.exp(splat.read(path).log_scales[0, 1]) < 1e-30


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ROW[:-1], "31 bytes are not whole splats"),
        (b"", "0 bytes"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(content)
    with pytest.raises(SplatFileError, match=message):
        splat.read(path)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        (struct.pack("<6f", 0, 0, float("nan"), 1, 1, 1) + ROW[24:], "without a position"),
        (struct.pack("<6f", 0, 0, 0, 1, -1, 1) + ROW[24:], "without a size"),
        (ROW[:28] + bytes([128] * 4), "without a rotation"),
    ],
)
def test_a_splat_that_cannot_be_drawn_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, row: bytes, reason: str
) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(ROW + row + ROW)
    assert len(splat.read(path)) == 2
    assert f"1 of 3 splats were left out: 1 {reason}" in caplog.text


def test_an_odd_rotation_among_the_first_splats_is_that_of_one_splat(tmp_path: Path) -> None:
    odd = ROW[:28] + bytes([255, 255, 0, 255])  # twice as long as a rotation is
    path = tmp_path / "a.splat"
    path.write_bytes(ROW * 3 + odd + ROW * 20)
    assert format_of(path).name == "splat"
    arrays = splat.read(path)
    assert len(arrays) == 24
    np.testing.assert_allclose(normalized(arrays.quaternions)[3], [0.5, 0.5, -0.5, 0.5], atol=5e-3)


def test_a_file_that_is_named_splat_and_is_none_is_told_why(tmp_path: Path) -> None:
    odd = ROW[:28] + bytes([255, 255, 0, 255])
    path = tmp_path / "a.splat"
    path.write_bytes(ROW * 2 + odd * 2)
    with pytest.raises(
        NotACompGSFile, match=r"2 of its first 4 splats, the first of them number 2, have a size or"
    ):
        format_of(path)
    path.write_bytes(b"short")
    with pytest.raises(NotACompGSFile, match=r"a \.splat holds 32 bytes a splat, this file has 5"):
        format_of(path)


def test_possible_splats_are_told_from_other_bytes() -> None:
    chance = np.random.default_rng(0)
    assert splat.begins(ROW) and splat.begins(ROW * 100 + ROW[:7])
    for length in (10, 32, 64, 4096):
        assert not splat.begins(chance.bytes(length)) or length == 32
    assert not splat.begins(b"") and not splat.begins(b"a text that is longer than one splat, and no splat")
