"""Poses and points that do not belong together stop a run before its first step, with the remedy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.errors import TrainingError
from compgs.scene.sight import depths_in
from compgs.scene.views import Points, Scene
from compgs.training.run.seen_points import check_points_seen
from compgs.training.splats.trainer import SplatTrainer
from compgs.training.trainer import Trainer

NEAR = 0.01


def scaled(scene: Scene, factor: float) -> Scene:
    """The same scene in another unit of length."""

    def shrunk(view):
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] *= factor
        return replace(view, camera=replace(view.camera, world_to_camera=pose))

    points = Points(scene.points.positions * np.float32(factor), scene.points.colors)
    return replace(scene, train_views=tuple(map(shrunk, scene.train_views)), points=points)


def with_points(scene: Scene, positions: np.ndarray) -> Scene:
    return replace(
        scene, points=Points(positions.astype(np.float32), np.zeros((len(positions), 3), np.uint8))
    )


def test_what_a_camera_sees_is_in_front_of_it_and_in_its_image(blob_scene: Scene) -> None:
    camera = replace(blob_scene.train_views[0].camera, world_to_camera=np.eye(4))  # 48 x 36, focal length 50
    positions = [[0, 0, 2], [0, 0, -2], [0.9, 0, 2], [1.2, 0, 2], [0, -0.7, 2], [0, -0.9, 2], [0, 0, 0]]
    depth, inside = depths_in(camera, np.array(positions, dtype=float))
    assert depth.tolist() == [2, -2, 2, 2, 2, 2, 0]
    assert inside.tolist() == [True, False, True, False, True, False, False]


@pytest.mark.parametrize("factor", [1.0, 0.01, 1000.0])
def test_a_scene_in_any_sensible_unit_passes(blob_scene: Scene, factor: float) -> None:
    check_points_seen(scaled(blob_scene, factor), NEAR)


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_a_scene_that_is_too_small_is_to_be_scaled_up(blob_scene: Scene, tiny_config, kind) -> None:
    trainer = kind(scaled(blob_scene, 1e-3), tiny_config, torch.device("cpu"))
    with pytest.raises(
        TrainingError, match=r"100 % of what .* nearer than 0.01 world units.* up, 1000 times"
    ):
        trainer.run(None, None)
    check_points_seen(scaled(blob_scene, 1e-3 * 1000), NEAR)


@pytest.mark.parametrize(("near", "far"), [(45, 55), (55, 45)])
def test_half_of_what_is_seen_may_be_too_near_to_be_drawn(blob_scene: Scene, near: int, far: int) -> None:
    camera = blob_scene.train_views[0].camera
    ahead = camera.center + 2.0 * camera.rotation[2]
    close = camera.center + 0.5 * NEAR * camera.rotation[2]
    scene = with_points(blob_scene, np.concatenate([np.tile(close, (near, 1)), np.tile(ahead, (far, 1))]))
    scene = replace(scene, train_views=scene.train_views[:1])
    if near < far:
        check_points_seen(scene, NEAR)
    else:
        with pytest.raises(TrainingError, match="55 % of what"):
            check_points_seen(scene, NEAR)


@pytest.mark.parametrize("kind", [Trainer, SplatTrainer])
def test_points_behind_all_cameras_stop_a_run(blob_scene: Scene, tiny_config, kind) -> None:
    behind = blob_scene.points.positions + np.array([0.0, 0.0, 500.0])
    trainer = kind(with_points(blob_scene, behind), tiny_config, torch.device("cpu"))
    with pytest.raises(TrainingError, match=r"0.0 % of the scene's points are in any training view"):
        trainer.run(None, None)


def test_strays_are_no_reason_to_stop(blob_scene: Scene) -> None:
    away = np.full((98 * len(blob_scene.points), 3), 1000.0)
    check_points_seen(with_points(blob_scene, np.concatenate([blob_scene.points.positions, away])), NEAR)
    far_more = np.full((120 * len(blob_scene.points), 3), 1000.0)
    with pytest.raises(TrainingError, match=r"0.8 %"):
        check_points_seen(
            with_points(blob_scene, np.concatenate([blob_scene.points.positions, far_more])), NEAR
        )
