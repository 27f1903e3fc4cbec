"""A file's cameras, as coarsely as it keeps them, tell whether a scene is the one it was trained on."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.codec.viewpoint_cameras import camera_from_viewpoint, viewpoints_from_cameras
from compgs.codec.viewpoints import decode_viewpoints, encode_viewpoints
from compgs.evaluation.camera_path import orbit
from compgs.evaluation.fit import misfits
from compgs.scene.viewpoints import choose_viewpoints
from compgs.scene.views import Points, Scene, View, scene_extent

CUBE = np.array([[-1.0, -1, -1], [1, 1, 1]])


def ring(count: int = 40, *, width: int = 64, height: int = 48, radius: float = 2.2) -> list[Camera]:
    circle = orbit(CUBE, frames=count, width=width, height=height, distance=radius)
    return [camera for _, camera in circle]


def scene_of(cameras: Sequence[Camera], *, test_every: int = 8, holdout: bool = True) -> Scene:
    views = [
        View(f"{i:03d}", camera, np.zeros((camera.height, camera.width, 3), np.uint8))
        for i, camera in enumerate(cameras)
    ]
    test = views[::test_every] if holdout else []
    extent = scene_extent(np.stack([camera.center for camera in cameras]))
    extent = extent if extent > 1e-6 else 3.0
    points = Points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    train = tuple(view for view in views if view not in test)
    return Scene("garden", train, tuple(test), points, (0.0, 0.0, 0.0), extent, Path("garden"))


def kept_by_a_file(scene: Scene, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Camera]:
    """Twelve cameras of training views, through the bytes of a file."""
    cameras = [view.camera for view in scene.train_views]
    chosen = [cameras[i] for i in choose_viewpoints(cameras, 12)]
    data = encode_viewpoints(viewpoints_from_cameras(chosen, (0.0, 0.0, 1.0), offset))
    return [camera_from_viewpoint(view, offset) for view in decode_viewpoints(data, "viewpoints").views]


def test_the_scene_itself_fits() -> None:
    scene = scene_of(ring())
    assert misfits(kept_by_a_file(scene), scene) == ()


def test_a_file_without_cameras_tells_nothing() -> None:
    assert misfits([], scene_of(ring())) == ()


def test_views_of_many_lenses_fit_though_a_file_keeps_but_sixteen() -> None:
    cameras = [replace(camera, fx=50.0 + i, width=64 + i) for i, camera in enumerate(ring())]
    scene = scene_of(cameras)
    chosen = [cameras[i] for i in range(1, 8)] + [cameras[i] for i in range(9, 16)]
    few = viewpoints_from_cameras(chosen, (0.0, 0.0, 1.0))
    kept = [camera_from_viewpoint(replace(view, width=70, fx=56.0)) for view in few.views]
    assert misfits(kept[:2] + [chosen[i] for i in range(2, 14)], scene) == ()


def test_another_resolution_is_said_with_both_sizes() -> None:
    small, large = ring(), ring(width=512, height=384)
    (note,) = misfits(kept_by_a_file(scene_of(small)), scene_of(large))
    assert "64 x 48" in note and "512 x 384" in note and "8 times larger" in note
    (note,) = misfits(kept_by_a_file(scene_of(large)), scene_of(small))
    assert "8 times smaller" in note


@pytest.mark.parametrize("test_every", [2, 3])
def test_views_that_were_trained_on_are_noticed_among_the_held_out(test_every: int) -> None:
    cameras = ring()
    kept = kept_by_a_file(scene_of(cameras))
    (note,) = misfits(kept, scene_of(cameras, test_every=test_every))
    held_out = {view.camera.center.tobytes() for view in scene_of(cameras, test_every=test_every).test_views}
    chosen = [cameras[int(np.argmin([np.linalg.norm(c.center - k.center) for c in cameras]))] for k in kept]
    count = sum(camera.center.tobytes() in held_out for camera in chosen)
    assert f"{count} are held out here" in note


def test_another_scene_is_called_so() -> None:
    for other in (ring(radius=2.4), ring(count=37)[1:-1]):
        (note,) = misfits(kept_by_a_file(scene_of(ring())), scene_of(other))
        assert note.startswith("another scene: none of the 12 cameras")


def test_a_scene_that_lost_views_says_how_many_cameras_are_left() -> None:
    cameras = ring()
    kept = kept_by_a_file(scene_of(cameras))
    lost = scene_of(cameras)
    gone = {c.center.tobytes() for c in cameras[20:]}
    left = replace(
        lost, train_views=tuple(v for v in lost.train_views if v.camera.center.tobytes() not in gone)
    )
    (note,) = misfits(kept, left)
    assert "of the 12 cameras that the file keeps only" in note


def test_cameras_that_only_turn_are_told_apart_by_their_directions() -> None:
    here = [replace(camera, world_to_camera=turned(camera)) for camera in ring()]
    scene = scene_of(here)
    assert misfits(kept_by_a_file(scene), scene) == ()
    (note,) = misfits(kept_by_a_file(scene), scene_of(here, test_every=2))
    assert "held out here" in note


def turned(camera: Camera) -> np.ndarray:
    """The camera's pose, at (1, 2, 3)."""
    pose = np.array(camera.world_to_camera)
    pose[:3, 3] = -camera.rotation @ (1.0, 2.0, 3.0)
    return pose


def test_captures_far_from_their_origin_fit() -> None:
    offset = (400_000.0, 5_000_000.0, 100.0)
    scene = scene_of([camera.moved([-x for x in offset]) for camera in ring()])
    assert misfits(kept_by_a_file(scene, offset), scene) == ()
