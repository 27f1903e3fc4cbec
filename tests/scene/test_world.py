"""Captures far from the origin of their coordinates: what is read, and the frame that training gets."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.cameras import Camera
from compgs.numerics.rotations import rotation_from_quaternion
from compgs.scene import Points, Scene, View, load_scene
from compgs.scene.colmap import read_sparse_model
from compgs.scene.colmap_writer import write_sparse_model
from compgs.scene.points import fallback_points, median_spacing
from compgs.scene.world import FAR, local_scene, world_offset

Write = Callable[..., Path]
SHIFT = np.array([4.2e6, 5.1e5, 3e3])  # metres: about what UTM gives


def shift_capture(folder: Path, shift: np.ndarray, *, text: bool = False) -> Path:
    """The same COLMAP capture, its whole world moved by `shift`."""
    sparse = folder / "sparse" / "0"
    model = read_sparse_model(sparse)
    images = [
        replace(image, translation=image.translation - rotation_from_quaternion(image.quaternion) @ shift)
        for image in model.images
    ]
    points = replace(model.points, positions=model.points.positions + shift)
    write_sparse_model(sparse, model.cameras.values(), images, points, text=text)
    return folder


@pytest.mark.parametrize("text", [False, True])
def test_colmap_captures_keep_a_millionth_of_a_metre_ten_thousand_kilometres_away(
    write_capture: Write, text: bool
) -> None:
    near = load_scene(write_capture(text=text))
    shift = np.array([1e7, -1e7, 1e7])
    far = load_scene(shift_capture(write_capture(text=text, folder="far"), shift, text=text))
    np.testing.assert_allclose(far.points.positions - shift, near.points.positions, rtol=0, atol=1e-6)
    for a, b in zip(far.train_views, near.train_views, strict=True):
        np.testing.assert_allclose(a.camera.center - shift, b.camera.center, rtol=0, atol=1e-6)
    assert far.extent == pytest.approx(near.extent, rel=1e-7)
    spacing = median_spacing(near.points.positions)
    assert median_spacing(far.points.positions) == pytest.approx(spacing, rel=1e-6)


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_transforms_and_their_double_precision_points_keep_it_too(tmp_path: Path, layout: str) -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(120, 3)) + 1e7
    centers = rng.normal(size=(3, 3)) + 1e7
    for i in range(3):
        Image.new("RGB", (20, 16)).save(tmp_path / f"{i}.png")
    frames = [
        {"file_path": f"{i}.png", "transform_matrix": np.c_[np.eye(3), c].tolist()}
        for i, c in enumerate(centers)
    ]
    values = {"w": 20, "h": 16, "fl_x": 20.0, "fl_y": 20.0, "cx": 10.0, "cy": 8.0}
    content = {**values, "ply_file_path": "points.ply", "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    header = f"ply\nformat {layout} 1.0\nelement vertex 120\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    lines = "\n".join(" ".join(map(repr, row)) for row in positions.tolist())
    body = lines.encode() if layout == "ascii" else positions.astype("<f8").tobytes()
    (tmp_path / "points.ply").write_bytes(header.encode() + body)
    scene = load_scene(tmp_path, holdout=False)
    np.testing.assert_allclose(scene.points.positions, positions, rtol=0, atol=1e-6)
    for view, center in zip(scene.train_views, centers, strict=True):
        np.testing.assert_allclose(view.camera.center, center, rtol=0, atol=1e-6)


def test_random_points_are_the_same_ones_far_away(write_capture: Write) -> None:
    cameras = [view.camera for view in load_scene(write_capture()).train_views]
    near, far = fallback_points(cameras, 200), fallback_points([c.moved(-SHIFT) for c in cameras], 200)
    np.testing.assert_allclose(far.positions - SHIFT, near.positions, rtol=0, atol=1e-6)


def test_far_cameras_in_one_place_are_told_from_cameras_a_metre_apart(write_capture: Write) -> None:
    ring = load_scene(shift_capture(write_capture(), SHIFT))
    assert ring.extent == pytest.approx(load_scene(write_capture(folder="b")).extent, rel=1e-6)
    folder = shift_capture(write_capture(folder="c"), SHIFT)
    model = read_sparse_model(folder / "sparse" / "0")
    images = [
        replace(image, translation=-rotation_from_quaternion(image.quaternion) @ SHIFT)
        for image in model.images
    ]
    write_sparse_model(folder / "sparse" / "0", model.cameras.values(), images, model.points)
    distance = np.median(np.linalg.norm(model.points.positions - SHIFT, axis=1))
    assert load_scene(folder).extent == pytest.approx(distance, rel=1e-6)


def scene_at(middle: np.ndarray, extent: float) -> Scene:
    """Two training cameras around `middle`, one held-out view elsewhere, three points near them."""
    views = []
    for name, step in (("a", (0.1, 0, 0)), ("b", (-0.1, 0, 0)), ("held out", (0, 0.7, 0))):
        pose = np.eye(4)
        pose[:3, 3] = -(middle + extent * np.array(step))
        camera = Camera(pose, 10.0, 10.0, 4.0, 3.0, 8, 6)
        views.append(View(name, camera, np.zeros((6, 8, 3), np.uint8)))
    points = Points(middle + extent * np.eye(3), np.zeros((3, 3), np.uint8))
    return Scene("made", tuple(views[:2]), tuple(views[2:]), points, (0.0, 0.0, 0.0), extent, Path())


@pytest.mark.parametrize("extent", [0.02, 1.0, 3000.0])
def test_captures_have_an_offset_from_a_hundred_extents_on(extent: float) -> None:
    direction = np.array([0.6, 0.0, -0.8])
    assert world_offset(scene_at(0.99 * FAR * extent * direction, extent)) == (0.0, 0.0, 0.0)
    assert any(world_offset(scene_at(1.01 * FAR * extent * direction, extent)))


def test_the_offset_is_the_training_cameras_mean_in_whole_units() -> None:
    assert world_offset(scene_at(np.array([4.2e6 + 0.4, -5.1e5 - 0.7, -0.3]), 5.0)) == (4.2e6, -510001.0, 0.0)
    assert world_offset(scene_at(np.array([4200123.4, 0, 0]), 5000.0)) == (4200123.0, 0.0, 0.0)
    assert not np.signbit(world_offset(scene_at(np.array([1e6, 0, -0.3]), 5.0))[2])


def test_of_a_small_scene_it_is_rounded_to_less_than_the_extent() -> None:
    assert world_offset(scene_at(np.array([2.53467, 0.0, 0.0]), 0.002)) == (2.535, 0.0, 0.0)


def test_a_scene_without_training_views_has_no_offset() -> None:
    assert world_offset(replace(scene_at(np.full(3, 1e6), 1.0), train_views=())) == (0.0, 0.0, 0.0)


def test_in_the_local_frame_cameras_see_the_same_and_points_are_single() -> None:
    scene = scene_at(SHIFT + 0.123, 2.0)
    local = local_scene(scene, world_offset(scene))
    assert local.points.positions.dtype == np.float32
    assert np.abs(local.points.positions).max() < 3
    for a, b in zip(scene.train_views + scene.test_views, local.train_views + local.test_views, strict=True):
        assert b.image is a.image
        seen = scene.points.positions @ a.camera.rotation.T + a.camera.translation
        found = local.points.positions @ b.camera.rotation.T + b.camera.translation
        np.testing.assert_allclose(found, seen, rtol=0, atol=1e-6)


def test_without_an_offset_views_stay_and_points_are_rounded_once() -> None:
    scene = scene_at(np.array([1.0, 2.0, 3.0]), 2.0)
    local = local_scene(scene, world_offset(scene))
    assert local.train_views[0] is scene.train_views[0] and local.test_views[0] is scene.test_views[0]
    np.testing.assert_array_equal(local.points.positions, scene.points.positions.astype(np.float32))
