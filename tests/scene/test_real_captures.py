"""Real captures, where they are at hand: poses, points and photographs agree with each other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.scene import Scene, load_scene
from compgs.scene.agreement import LEAST_AGREEMENT, color_agreement
from compgs.scene.colmap import read_sparse_model
from compgs.scene.points import voxel_grid

SCENES = Path(__file__).parents[3] / "shared" / "scenes"


def capture(name: str) -> Path:
    folder = SCENES / name
    if not folder.is_dir():
        pytest.skip(f"the capture {name} is not in ../shared/scenes")
    return folder


@pytest.mark.parametrize(("name", "train", "test"), [("plush_480", 81, 12), ("brighton_480", 15, 3)])
def test_a_real_capture_loads_whole(name: str, train: int, test: int) -> None:
    scene = load_scene(capture(name))
    assert (len(scene.train_views), len(scene.test_views)) == (train, test)
    assert scene.notes == ()
    for view in scene.train_views:
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
    coordinates, size = voxel_grid(scene.points)
    assert size < 0.02 * scene.extent
    assert len(coordinates) > 0.5 * len(scene.points)


@pytest.mark.parametrize("name", ["plush_480", "brighton_480"])
def test_triangulated_points_project_to_their_observations(name: str) -> None:
    """Fixes pose, axes and intrinsics at once: the median error of a good reconstruction is below a pixel."""
    folder = capture(name)
    scene = load_scene(folder, holdout=False)
    model = read_sparse_model(folder / "sparse" / "0")
    rows = {point_id: row for row, point_id in enumerate(model.points.point_ids.tolist())}
    views = {view.name: view for view in scene.train_views}
    errors = []
    for image in model.images:
        known = np.array([point_id in rows for point_id in image.point_ids.tolist()], dtype=bool)
        camera = views[image.name].camera
        which = [rows[point_id] for point_id in image.point_ids[known].tolist()]
        x, y, z = (scene.points.positions[which] @ camera.rotation.T + camera.translation).T
        projected = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
        errors.append(np.linalg.norm(projected - image.observations[known], axis=1))
    assert np.median(np.concatenate(errors)) < 1.0


def point_color_error(scene: Scene) -> float:
    """Median difference between the points' colors and the views' pixels at their projections."""
    differences = []
    for view in scene.train_views[::8]:
        camera = view.camera
        x, y, z = (scene.points.positions @ camera.rotation.T + camera.translation).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        seen = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        pixels = view.image[v[seen].astype(int), u[seen].astype(int)].astype(int)
        differences.append(np.abs(pixels - scene.points.colors[seen]).mean(axis=1))
    return float(np.median(np.concatenate(differences)))


def test_points_have_the_colors_of_the_pixels_they_project_to() -> None:
    scene, half = load_scene(capture("plush_480")), load_scene(capture("plush_480"), downscale=2)
    assert half.train_views[0].image.shape == (179, 240, 3)
    assert point_color_error(scene) < 25
    assert point_color_error(half) < 25


@pytest.mark.parametrize("name", ["plush_480", "brighton_480"])
def test_a_real_capture_is_told_from_itself_with_exchanged_photographs(name: str) -> None:
    scene = load_scene(capture(name), downscale=2)
    views = scene.train_views
    others = tuple(
        replace(view, pixels=other.image) for view, other in zip(views, views[5:] + views[:5], strict=True)
    )
    own, exchanged = color_agreement(scene), color_agreement(replace(scene, train_views=others))
    assert own is not None and exchanged is not None
    assert exchanged < LEAST_AGREEMENT < own
