"""The first version of .sog: images taken apart by hand, and damage that is named."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compgs.errors import SplatFileError
from compgs.formats import sog
from compgs.formats.arrays import harmonics_above_dc
from compgs.opening import format_of

from .foreign import SOG_COUNT, sog_first_bytes, sog_first_files, webp

CASE = Path(__file__).parents[3] / "shared" / "cases" / "sog_v1_meta" / "meta.json"
Files = dict[str, bytes]


def folder(path: Path, files: Files) -> Path:
    path.mkdir(exist_ok=True)
    for name, content in files.items():
        (path / name).write_bytes(content)
    return path / "meta.json"


def lerp(low: float, high: float, byte: int) -> float:
    return low + (high - low) * byte / 255


@pytest.mark.parametrize("degree", range(4))
def test_a_file_made_by_hand_holds_the_splats_it_describes(tmp_path: Path, degree: int) -> None:
    path, pixels = folder(tmp_path, sog_first_files(degree)), sog_first_bytes(degree)
    assert format_of(path).name == "sog"
    read = sog.read(path)
    assert (len(read), read.degree) == (SOG_COUNT, degree)
    for i in range(SOG_COUNT):
        for axis, (low, high) in enumerate([(-1, 1), (0, 2), (-2, 0)]):
            step = int(pixels["low"][0, i, axis]) + 256 * int(pixels["high"][0, i, axis])
            log = low + (high - low) * step / 65535
            expected = np.sign(log) * (np.exp(abs(log)) - 1)
            np.testing.assert_allclose(read.means[i, axis], expected, rtol=1e-5, atol=1e-6)
        for axis, (low, high) in enumerate([(-5, -1), (-4, -2), (-3, -3)]):
            expected = lerp(low, high, pixels["scales"][0, i, axis])
            np.testing.assert_allclose(read.log_scales[i, axis], expected, rtol=1e-6)
        r, g, b, opacity = pixels["colors"][0, i]
        np.testing.assert_allclose(read.dc[i], [lerp(-2, 2, r), lerp(-1, 1, g), lerp(0, 1, b)], atol=1e-6)
        np.testing.assert_allclose(read.opacity_logits[i], lerp(-8, 6, opacity), atol=1e-5)
        row, entry = divmod(int(pixels["labels"][0, i, 0]), 64)
        for k in range(harmonics_above_dc(degree)):
            shown = pixels["palette"][row, entry * harmonics_above_dc(degree) + k]
            np.testing.assert_allclose(read.rest[i, k], [lerp(-0.5, 1, x) for x in shown], atol=1e-6)
    small, half = (128 / 255 - 0.5) * 2**0.5, 0.5 * 2**0.5
    missing = (1 - 2 * small**2 - half**2) ** 0.5
    np.testing.assert_allclose(
        read.quaternions[:2], [[small, missing, small, half], [missing, -half, small, small]]
    )
    assert sum(sog.component_bytes(path).values()) == sum(
        file.stat().st_size for file in tmp_path.iterdir()
    ) - (0 if degree else (tmp_path / "labels.webp").stat().st_size)


def test_a_zip_of_the_same_is_read_as_well(tmp_path: Path) -> None:
    beside, zipped = sog.read(folder(tmp_path, sog_first_files(2))), tmp_path / "a.sog"
    with zipfile.ZipFile(zipped, "w") as archive:
        for name, content in sog_first_files(2).items():
            archive.writestr(name, content)
    inside = sog.read(zipped)
    for name, values in beside.columns.items():
        assert np.array_equal(values, inside.columns[name]), name


@pytest.mark.skipif(not CASE.is_file(), reason=f"no {CASE}")
def test_a_file_of_another_program_is_read() -> None:
    read = sog.read(CASE)
    assert (len(read), read.degree) == (24, 0)
    assert read.log_scales.min() >= -5 and read.log_scales.max() <= -1
    assert np.abs(read.opacity_logits).max() <= 8


def meta_with(change: Callable[[dict[str, Any]], object]) -> Callable[[Files], None]:
    def edit(files: Files) -> None:
        meta = json.loads(files["meta.json"])
        change(meta)
        files["meta.json"] = json.dumps(meta).encode()

    return edit


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (meta_with(lambda m: m["means"].pop("shape")), "means.shape is None, expected a number of splats"),
        (meta_with(lambda m: m["means"].update(shape=[])), "means.shape is None"),
        (meta_with(lambda m: m["means"].update(shape=["3"])), "means.shape is '3'"),
        (meta_with(lambda m: m["means"].update(shape=[0, 3])), "holds no splats"),
        (meta_with(lambda m: m["means"].update(shape=[1 << 40, 3])), "promises 1099511627776 splats"),
        (meta_with(lambda m: m["means"].update(shape=[4, 3])), "has 3 pixels for 4 splats"),
        (meta_with(lambda m: m.update(means=[1])), "means.shape is None"),
        (meta_with(lambda m: m["scales"].update(mins=[0, 0])), "scales.mins: expected 3 numbers"),
        (meta_with(lambda m: m["sh0"].update(maxs=[0, 0, 0])), "sh0.maxs: expected 4 numbers"),
        (meta_with(lambda m: m["sh0"].update(maxs=[0, 0, 0, 10**400])), "sh0.maxs: expected 4 finite numbers"),
        (meta_with(lambda m: m["shN"].update(mins=None)), "shN.mins: expected a finite number"),
        (meta_with(lambda m: m["shN"].update(maxs=[1])), "shN.maxs: expected numbers, found"),
        (meta_with(lambda m: m["shN"].update(files=["labels.webp", "palette.webp"])), "a palette of 3 pixels a row"),
        (lambda files: files.pop("scales.webp"), "scales.webp, which meta.json names, is missing"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_with_what_is_wrong(
    tmp_path: Path, damage: Callable[[Files], None], message: str
) -> None:
    files = sog_first_files(1)
    damage(files)
    path = folder(tmp_path, files)
    with pytest.raises(SplatFileError, match=message) as caught:
        sog.read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_label_without_an_entry_leaves_its_splat_out(tmp_path: Path) -> None:
    files = sog_first_files(1)
    files["labels.webp"] = webp(np.array([[[64, 0, 0], [128, 0, 0], [3, 0, 0]]]))
    whole = sog.read(folder(tmp_path / "whole", sog_first_files(1)))
    read = sog.read(folder(tmp_path / "damaged", files))
    assert np.array_equal(read.means, whole.means[[0, 2]])
