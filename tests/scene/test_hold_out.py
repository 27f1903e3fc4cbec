"""Which views are held out, and how far views are from one another."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.scene import load_scene
from compgs.scene.angles import angular_distances, nearest_angles
from compgs.scene.colmap import ColmapCamera
from compgs.scene.hold_out import every, sector

Write = Callable[..., Path]


def looking(center: np.ndarray, target: np.ndarray) -> Camera:
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return Camera(pose, 50.0, 50.0, 32.0, 24.0, 64, 48)


def ring(count: int, height: float = 0.0) -> list[Camera]:
    """Around the origin, at a distance of 3, `360 / count` degrees from one another."""
    angles = 2 * np.pi * np.arange(count) / count
    return [
        looking(np.array([3 * np.cos(a), 3 * np.sin(a), height]), np.array([0, 0, height])) for a in angles
    ]


BALL = np.random.default_rng(0).normal(size=(2000, 3)) * 0.1  # what the cameras look at


def test_the_distance_of_views_around_a_thing_is_the_angle_between_them() -> None:
    cameras = ring(12)
    found = angular_distances(cameras[:1], cameras, BALL, 3.0)[0]
    np.testing.assert_allclose(found, [0, 30, 60, 90, 120, 150, 180, 150, 120, 90, 60, 30], atol=1.5)


def test_the_distance_of_views_from_one_place_is_how_far_they_turn() -> None:
    place = np.array([1.0, 2.0, 0.5])
    turns = np.radians([0, 10, 75, 180])
    cameras = [looking(place, place + np.array([np.cos(t), np.sin(t), 0])) for t in turns]
    found = angular_distances(cameras[:1], cameras, np.zeros((0, 3)), 1.0)[0]
    np.testing.assert_allclose(found, np.degrees(turns), atol=1e-4)


def test_parallel_views_are_as_far_as_their_subject_shows() -> None:
    """Cameras side by side, one unit apart, that look at a wall ten units ahead."""
    cameras = [looking(np.array([x, 0.0, 0.0]), np.array([x, 10.0, 0.0])) for x in (0.0, 1.0, 10.0)]
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-20, 20, 4000), np.full(4000, 10.0), rng.uniform(-9, 9, 4000)])
    found = angular_distances(cameras[:1], cameras, wall, 1.0)[0]
    np.testing.assert_allclose(found, np.degrees(np.arctan([0, 0.1, 1.0])), atol=1e-6)


def test_a_turn_about_the_axis_is_no_distance() -> None:
    (camera,) = ring(1)
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    turned = Camera(roll @ camera.world_to_camera, 50.0, 50.0, 32.0, 24.0, 64, 48)
    assert angular_distances([camera], [turned], BALL, 1.0)[0, 0] == pytest.approx(0, abs=1e-5)


def test_the_nearest_of_no_views_is_none() -> None:
    assert nearest_angles(ring(2), [], BALL, 1.0) == [None, None]
    assert nearest_angles([], ring(2), BALL, 1.0) == []


def test_a_sector_of_a_ring_is_an_arc_around_the_first_view_by_name() -> None:
    names = [f"{i:02d}" for i in range(24)]
    assert sector(names, ring(24), BALL, 3.0, 8) == {"23", "00", "01"}
    assert every(names, 8) == {"00", "08", "16"}
    shuffled = np.random.default_rng(1).permutation(24)
    cameras = ring(24)
    assert sector([names[i] for i in shuffled], [cameras[i] for i in shuffled], BALL, 3.0, 8) == {
        "23",
        "00",
        "01",
    }


def test_a_sector_of_several_rings_holds_part_of_each_out() -> None:
    cameras = [*ring(36), *ring(36, 0.3), *ring(36, 0.6)]
    names = [f"{i:03d}" for i in range(108)]
    held_out = sector(names, cameras, BALL, 3.0, 8)
    assert len(held_out) == 14
    assert {int(name) // 36 for name in held_out} == {0, 1, 2}
    trained = [camera for name, camera in zip(names, cameras, strict=True) if name not in held_out]
    angles = nearest_angles([cameras[0]], trained, BALL, 3.0)
    assert angles[0] is not None and angles[0] > 15  # among every eighth it is 10


def test_a_scene_is_held_out_by_sector_where_that_is_asked_for(write_capture: Write) -> None:
    folder = write_capture([f"{i:02d}.png" for i in range(24)])
    scene = load_scene(folder, split="sector")
    assert {view.name for view in scene.test_views} == {"23.png", "00.png", "01.png"}
    assert len(scene.train_views) == 21
    assert scene.split == "a sector of 3 of 24 views" and load_scene(folder).split == "one in 8 by name"
    assert load_scene(folder, split="sector", holdout=False).test_views == ()
    assert len(load_scene(folder, split="sector", test_every=4).test_views) == 6
    with pytest.raises(ConfigError, match="split 'half': expected one of auto, every, sector"):
        load_scene(folder, split="half")  # type: ignore[arg-type]


def test_large_photographs_are_read_at_1600_pixels_where_that_is_left_to_the_program(
    write_capture: Write,
) -> None:
    lens = ColmapCamera(1, "PINHOLE", 2400, 1200, (2000.0, 2000.0, 1200.0, 600.0))
    folder = write_capture([f"{i}.jpg" for i in range(3)], cameras=(lens,))
    scene = load_scene(folder, downscale="auto")
    camera = scene.train_views[0].camera
    assert (camera.width, camera.height, camera.fx) == (1600, 800, pytest.approx(2000 / 1.5))
    assert scene.train_views[0].image.shape == (800, 1600, 3)
    assert scene.notes == (
        "photographs of 2400 x 1200 pixels are read at 1600 x 800 (downscale=auto); downscale=1 reads all their pixels",
    )
    assert load_scene(folder).train_views[0].camera.width == 2400


@pytest.mark.parametrize("size", [(24, 16), (1900, 1000), (1500, 1400)])
def test_photographs_of_two_megapixels_and_those_not_longer_than_that_are_read_whole(
    write_capture: Write, size: tuple[int, int]
) -> None:
    lens = ColmapCamera(1, "PINHOLE", *size, (2000.0, 2000.0, size[0] / 2, size[1] / 2))
    folder = write_capture(["a.jpg", "b.jpg"], cameras=(lens,))
    scene = load_scene(folder, downscale="auto")
    assert (scene.train_views[0].camera.width, scene.train_views[0].camera.height) == size
    assert scene.notes == ()


def test_masks_are_reduced_with_their_photographs_by_factors_that_are_not_whole(write_capture: Write) -> None:
    lens = ColmapCamera(1, "PINHOLE", 2000, 1200, (2000.0, 2000.0, 1000.0, 600.0))
    folder = write_capture(["a.jpg", "b.jpg"], cameras=(lens,))
    mask = np.full((1200, 2000), 255, dtype=np.uint8)
    mask[:, :1000] = 0
    (folder / "masks").mkdir()
    Image.fromarray(mask).save(folder / "masks" / "b.png")
    view = load_scene(folder, downscale="auto").train_views[0]
    assert view.mask.shape == view.image.shape[:2] == (960, 1600)
    assert not view.mask[:, :800].any() and view.mask[:, 800:].all()
