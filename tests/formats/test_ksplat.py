"""A .ksplat file holds what the layout says: files are written here, a splat at a time, from known numbers."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import ksplat
from compgs.opening import component_bytes, format_of, open_scene

from .foreign import BUCKET_SIDE, KSPLAT_SECTIONS, STEPS, ksplat_file, ksplat_numbers


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_file_holds_the_splats_that_were_ksplat_file(tmp_path: Path, level: int) -> None:
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat_file(level))
    assert format_of(path).name == "ksplat"
    read = ksplat.read(path)
    assert (len(read), read.degree) == (18, 2)
    first = 0
    for i, (degree, _, buckets) in enumerate(KSPLAT_SECTIONS):
        count = sum(buckets)
        known, rows = ksplat_numbers(count, i), slice(first, first + count)
        bucket_of = [bucket for bucket, size in enumerate(buckets) for _ in range(size)]
        moved = (known["steps"] - STEPS) * (BUCKET_SIDE / 2 / STEPS) + known["center"][bucket_of]
        half = 2e-3 if level else 1e-6
        np.testing.assert_allclose(read.means[rows], moved if level else known["center"], atol=1e-5)
        np.testing.assert_allclose(np.exp(read.log_scales[rows]), known["scales"], rtol=half)
        np.testing.assert_allclose(read.quaternions[rows], known["rotation"], atol=half)
        np.testing.assert_allclose(255 * read.opacities[rows], known["color"][:, 3], atol=1e-3)
        shown = 255 * (0.5 + read.dc[rows] * (0.25 / np.pi) ** 0.5)
        np.testing.assert_allclose(shown, known["color"][:, :3], atol=1e-3)
        atol = {0: 1e-6, 1: 1e-3, 2: 3 / 255}[level]
        for channel in range(3):
            degree1 = known["harmonics"][:, 3 * channel : 3 * channel + 3]
            np.testing.assert_allclose(read.rest[rows, :3, channel], degree1, atol=atol)
            degree2 = known["harmonics"][:, 9 + 5 * channel : 14 + 5 * channel] * (degree == 2)
            np.testing.assert_allclose(read.rest[rows, 3:, channel], degree2, atol=atol)
        first += count
    assert sum(component_bytes(path).values()) == path.stat().st_size
    assert open_scene(path).counts == {"splats": 18}


def test_a_range_of_harmonics_that_is_not_said_is_that_of_the_first_files(tmp_path: Path) -> None:
    path = tmp_path / "a.ksplat"
    said, unsaid = ksplat_file(2, low=-1.5, high=1.5), bytearray(ksplat_file(2, low=-1.5, high=1.5))
    unsaid[36:44] = bytes(8)
    path.write_bytes(said)
    expected = ksplat.read(path).rest
    path.write_bytes(unsaid)
    assert np.array_equal(ksplat.read(path).rest, expected)


def test_room_for_splats_that_are_not_there_is_passed_over(tmp_path: Path) -> None:
    path, data = tmp_path / "a.ksplat", bytearray(ksplat_file(0, [(0, 4, [4])]))
    data[16:20] = data[4096:4100] = struct.pack("<I", 3)
    path.write_bytes(data)
    np.testing.assert_allclose(ksplat.read(path).means, ksplat_numbers(4, 0)["center"][:3], atol=1e-6)


def at(position: int, form: str, value: float) -> Callable[[bytes], bytes]:
    packed = struct.pack(f"<{form}", value)
    return lambda data: data[:position] + packed + data[position + len(packed) :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:4000], "ends after 4000 bytes, within its header"),
        (lambda data: data[:6000], "promises 4 sections in 6000 bytes"),
        (lambda data: data[:-1], "section 2 ends at byte .* the file after"),
        (at(0, "B", 1), "version 1.1"),
        (at(20, "H", 3), "at level 3; expected 0.1 at level 0 to 2"),
        (at(4, "I", 1 << 31), "promises 2147483648 sections"),
        (at(16, "I", 17), "17 splats are promised, its sections have 18"),
        (at(4096, "I", 13), "13 splats in a section with room for 12"),
        (at(4100, "I", 1 << 31), "section 0 ends at byte"),
        (at(4096 + 12, "I", 5), "do not make a section of 5 buckets"),
        (at(4096 + 8, "I", 1 << 31), "do not make a section"),
        (at(4096 + 20, "H", 1024), "do not make a section"),
        (at(4096 + 36, "I", 1 << 31), "do not make a section"),
        (at(4096 + 40, "H", 4), "degree 4; expected 0 to 3"),
        (at(8192, "I", 0), "9 splats lie in buckets, expected 12"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    tmp_path: Path, damage: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "a.ksplat"
    path.write_bytes(damage(ksplat_file(1)))
    with pytest.raises(SplatFileError, match=message) as caught:
        ksplat.read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_other_files_of_zeros_are_not_taken_for_one() -> None:
    assert ksplat.begins(ksplat_file(0)[:4096])
    assert not ksplat.begins(bytes(4096))
    assert not ksplat.begins(ksplat_file(0)[:4000])
    assert not ksplat.begins(b"\x01" + ksplat_file(0)[1:4096])
    assert not ksplat.begins(ksplat_file(0)[:4095] + b"x")
