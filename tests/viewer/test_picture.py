"""The picture in the page is the renderer's: headless Chromium against compgs.render at the same cameras."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgs
from compgs.cameras import Camera
from compgs.codec.content import FileContent
from compgs.codec.writer import write_content
from compgs.metrics import to_8bit
from compgs.model.hybrid_model import HybridModel
from compgs.render import RasterSettings
from compgs.viewer import html_page

from .headless import visit

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402
from made_heads import make_heads  # noqa: E402

LEAST_DB = 35.0
SHARED = make_dimensions(5, paper_groups(12, 0))
SEPARATE = make_dimensions(4, paper_groups(8, 3), "separate", 16)
CONTENTS = {
    "paired": make_content(400, 3, SHARED),
    "separate": make_content(400, 4, SEPARATE),
    "far away": replace(make_content(400, 5, SHARED), world_offset=(4.5e6, -2.25e5, 1.0)),
    # 5.9 pixels^2 in the larger pictures of `cameras_around`, 0.23 in the smallest; a file without has 0.3 in all.
    "dilated": make_content(400, 3, SHARED, angular_dilation=2.0**-12),
    # The least, 0.02 pixels^2, in all.
    "hardly dilated": make_content(400, 7, SHARED, angular_dilation=2.0**-26),
}


def written(content: FileContent) -> bytes:
    heads = make_heads(np.random.default_rng(5), content.dimensions)
    return write_content(replace(content, heads=heads))


def decoded(content: FileContent, folder: Path) -> HybridModel:
    (folder / "scene.cgs").write_bytes(written(content))
    return compgs.decode(folder / "scene.cgs")


def cameras_around(content: FileContent) -> list[Camera]:
    """Beside the scene, within it, and beside it in a small picture; their principal points are off the middle."""
    middle = content.coordinates.mean(0) * content.voxel_size + np.array(content.world_offset)
    extent = float(np.ptp(content.coordinates, axis=0).max()) * content.voxel_size
    beside = looking(middle + extent * np.array((0.4, -0.5, -1.1)), middle)
    within = looking(middle + extent * np.array((0.05, 0.1, 0.0)), middle + extent)
    return [beside, within, beside.resized(40, 28)]


def looking(centre: np.ndarray, target: np.ndarray) -> Camera:
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, (0.0, -1.0, 0.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(pose, 150.0, 160.0, 90.0, 75.0, 200, 140)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255.0**2 / max(((a.astype(float) - b.astype(float)) ** 2).mean(), 1e-9)))


@pytest.mark.parametrize(
    ("name", "camera", "wrong"),
    [
        ("dilated", 0, 0.3),  # that of a file without
        ("dilated", 2, 5.9),  # the same pixels in every size
        ("hardly dilated", 0, 0.3),
        ("hardly dilated", 2, 2.0**-26 * 30 * 32),  # no least
    ],
)
def test_another_dilation_would_be_seen(name: str, camera: int, wrong: float, tmp_path: Path) -> None:
    model = decoded(CONTENTS[name], tmp_path)
    seen_from = cameras_around(CONTENTS[name])[camera]
    wrongly = RasterSettings(background=model.background, dilation=wrong)
    expected, found = (compgs.render(model, seen_from, s).image for s in (None, wrongly))
    assert psnr(to_8bit(found), to_8bit(expected)) < LEAST_DB - 5


@pytest.mark.parametrize(
    "name",
    [name if name == "dilated" else pytest.param(name, marks=pytest.mark.slow) for name in CONTENTS],
)
def test_the_page_shows_what_the_renderer_does(name: str, browser: str, tmp_path: Path) -> None:
    content = CONTENTS[name]
    model = decoded(content, tmp_path)
    cameras = cameras_around(content)
    seen = visit(browser, tmp_path / "browser", html_page(written(content), name), cameras)
    assert seen.error == ": " and len(seen.pictures) == len(cameras)
    for picture, camera in zip(seen.pictures, cameras, strict=True):
        image = compgs.render(model, camera).image
        expected = np.rint(np.clip(image, 0, 1) * 255)
        assert expected.std() > 10  # something is there to see
        assert psnr(picture, expected) >= LEAST_DB


def test_a_damaged_file_is_named_in_the_page(browser: str, tmp_path: Path) -> None:
    data = bytearray(written(CONTENTS["paired"]))
    data[-40] ^= 1
    error = visit(browser, tmp_path / "browser", html_page(bytes(data), "damaged"), []).error
    assert error.startswith("This file is damaged: ") and "checksum does not match" in error
