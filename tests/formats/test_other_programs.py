"""Our files, read by software that was not written here, and theirs read by us: axes, orders, activations, harmonics.

PlayCanvas's splat-transform (node) and gsply (Python) are used where they are: the first on PATH, or named by
SPLAT_TRANSFORM, a path to its program. Pictures are drawn by our renderer from the .ply files that they make.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from compgs import metrics
from compgs.evaluation.camera_path import surround
from compgs.formats import SplatArrays, encoded
from compgs.formats import spz as spz_format
from compgs.formats.frames import RIGHT_UP_BACK, turned
from compgs.opening import open_scene
from compgs.render import render

PROGRAM = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
needs_program = pytest.mark.skipif(PROGRAM is None, reason="no splat-transform on PATH or in SPLAT_TRANSFORM")


@pytest.fixture
def scene(made) -> SplatArrays:
    """Long, turned splats whose colors change with the direction: nothing looks right by chance."""
    arrays: SplatArrays = made(300, 3)
    arrays.log_scales[:] = np.random.default_rng(1).normal(size=(300, 3)) - 1.5
    return arrays


def pictures(path: Path) -> list[np.ndarray]:
    model = open_scene(path)
    cameras = [camera for _, camera in surround(np.zeros((8, 3)) + np.eye(3).repeat(3, 0)[:8] * 2)][::9]
    return [metrics.to_8bit(render(model, camera).image) for camera in cameras]


def likeness(one: Path, other: Path) -> float:
    """dB, mean."""
    pairs = zip(pictures(one), pictures(other), strict=True)
    return float(np.mean([min(metrics.psnr(a, b), 100.0) for a, b in pairs]))


def transformed(source: Path, target: Path, *options: str) -> Path:
    command = [str(PROGRAM), "--overwrite", "--quiet", *options, str(source), str(target)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return target


@needs_program
@pytest.mark.parametrize(("name", "least"), [("ply", 100.0), ("spz", 38.0), ("spz4", 38.0), ("sog", 45.0)])
def test_what_we_write_looks_the_same_to_splat_transform(
    scene: SplatArrays, tmp_path: Path, name: str, least: float
) -> None:
    ours = tmp_path / f"ours.{name.rstrip('4')}"
    if name == "spz4":
        pytest.importorskip("zstandard")
        ours.write_bytes(spz_format.encoded(scene, 4))
    else:
        ours.write_bytes(encoded(scene, name))
    original = tmp_path / "original.ply"
    original.write_bytes(encoded(scene, "ply"))
    theirs = transformed(ours, tmp_path / "theirs.ply")
    assert likeness(theirs, original) >= least
    assert likeness(theirs, ours) > 60  # rounding apart, both readers take the file for the same splats


@needs_program
@pytest.mark.parametrize(
    ("suffix", "options", "least"),
    [
        ("spz", ["--spz-version", "3"], 35.0),
        ("spz", ["--spz-version", "4"], 35.0),
        ("glb", [], 90.0),
        ("sog", ["--gpu", "cpu"], 28.0),
        ("compressed.ply", [], 40.0),
    ],
    ids=["spz3", "spz4", "glb", "sog", "compressed.ply"],
)
def test_what_splat_transform_writes_looks_the_same_to_us(
    scene: SplatArrays, tmp_path: Path, suffix: str, options: list[str], least: float
) -> None:
    if options[-1:] == ["4"]:
        pytest.importorskip("zstandard")
    original = tmp_path / "original.ply"
    original.write_bytes(encoded(scene, "ply"))
    theirs = transformed(original, tmp_path / f"theirs.{suffix}", *options)
    assert likeness(theirs, original) >= least


@needs_program
def test_levels_that_splat_transform_writes_are_opened_one_by_one(made, tmp_path: Path) -> None:
    sources = []
    for level, count in enumerate((300, 60)):
        sources.append(tmp_path / f"{level}.ply")
        sources[-1].write_bytes(encoded(made(count, 1, level), "ply"))
    written = tmp_path / "levels" / "lod-meta.json"
    tagged = [str(sources[0]), "-l", "0", str(sources[1]), "-l", "1"]
    command = [str(PROGRAM), "--overwrite", "--quiet", "--gpu", "cpu", *tagged, str(written)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    for level, source in enumerate(sources):
        model, original = open_scene(written, level=level), open_scene(source)
        assert model.counts == original.counts
        ours, theirs = (np.sort(each.bounds[0], axis=0) for each in (model, original))
        np.testing.assert_allclose(ours, theirs, atol=2e-3)


@needs_program
def test_our_glb_and_that_of_splat_transform_draw_the_same_picture(
    scene: SplatArrays, tmp_path: Path
) -> None:
    original, ours = tmp_path / "original.ply", tmp_path / "ours.glb"
    original.write_bytes(encoded(scene, "ply"))
    ours.write_bytes(encoded(scene, "glb"))
    assert likeness(ours, transformed(original, tmp_path / "theirs.glb")) > 90


def test_gsply_reads_our_splats_as_they_are(scene: SplatArrays, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply")
    path = tmp_path / "a.ply"
    path.write_bytes(encoded(scene, "ply"))
    read = gsply.plyread(str(path))
    np.testing.assert_array_equal(read.means, scene.means)
    np.testing.assert_array_equal(read.scales, scene.log_scales)
    np.testing.assert_array_equal(read.quats, scene.quaternions)
    np.testing.assert_array_equal(read.opacities, scene.opacity_logits)
    np.testing.assert_array_equal(read.sh0, scene.dc)
    np.testing.assert_array_equal(np.reshape(read.shN, scene.rest.shape), scene.rest)


def test_gsply_reads_our_spz_as_we_do_but_for_the_axes_which_it_leaves(
    scene: SplatArrays, tmp_path: Path
) -> None:
    gsply = pytest.importorskip("gsply")
    path = tmp_path / "a.spz"
    path.write_bytes(encoded(scene, "spz"))
    theirs, ours = gsply.read_spz(str(path)), turned(spz_format.read(path), RIGHT_UP_BACK)
    np.testing.assert_array_equal(theirs.means, ours.means)
    np.testing.assert_allclose(theirs.quats, ours.quaternions, atol=1e-6)
    np.testing.assert_array_equal(theirs.scales, ours.log_scales)
    np.testing.assert_allclose(theirs.opacities, ours.opacity_logits, atol=1e-5)
    np.testing.assert_allclose(theirs.sh0, ours.dc, atol=1e-6)
    np.testing.assert_array_equal(np.reshape(theirs.shN, ours.rest.shape), ours.rest)
