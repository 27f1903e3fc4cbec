"""Cameras from files and on circles."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compgs.cameras import Camera
from compgs.errors import SceneError
from compgs.evaluation.camera_path import (
    USUAL_DISTANCE,
    between,
    camera_entry,
    distance_of_all,
    look_at,
    orbit,
    read_cameras,
    whole,
)

GOOD = camera_entry(Camera(np.eye(4), 100.0, 101.0, 32.0, 24.0, 64, 48), "a view")


def test_a_camera_survives_the_file(tmp_path: Path) -> None:
    pose = look_at(np.array([3.0, -1.0, 2.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    camera = Camera(pose, 100.5, 101.25, 31.5, 24.0, 64, 48)
    (tmp_path / "cameras.json").write_text(json.dumps([GOOD, camera_entry(camera, "b")]))
    names, cameras = zip(*read_cameras(tmp_path / "cameras.json"), strict=True)
    assert names == ("a view", "b")
    np.testing.assert_array_equal(cameras[1].world_to_camera, pose)
    assert (cameras[1].fx, cameras[1].fy, cameras[1].cx, cameras[1].cy) == (100.5, 101.25, 31.5, 24.0)
    assert (cameras[1].width, cameras[1].height) == (64, 48)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("", "not a camera file"),
        ("{}", "list"),
        ("[]", "none"),
        ("[3]", "camera 0"),
        (json.dumps([GOOD, {k: v for k, v in GOOD.items() if k != "fx"}]), "camera 1: 'fx'"),
        (json.dumps([GOOD | {"width": 0}]), "pixels"),
        (json.dumps([GOOD | {"width": 10**9}]), "pixels"),
        (json.dumps([GOOD | {"fx": "wide"}]), "number"),
        (json.dumps([GOOD | {"fx": -1}]), "focal"),
        (json.dumps([GOOD | {"world_to_camera": [[1, 2], [3, 4]]}]), "4 rows"),
        (
            json.dumps(
                [GOOD | {"world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}]
            ),
            "rotation",
        ),
        (json.dumps([GOOD | {"world_to_camera": (2 * np.eye(4)).tolist()}]), "rotation"),
        ('[{"world_to_camera": [[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]', "missing"),
    ],
)
def test_bad_camera_files_are_refused_by_name(tmp_path: Path, content: str, word: str) -> None:
    path = tmp_path / "path.json"
    path.write_text(content)
    with pytest.raises(SceneError, match=word) as caught:
        read_cameras(path)
    assert str(path) in str(caught.value)


def test_a_missing_camera_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"nowhere\.json"):
        read_cameras(tmp_path / "nowhere.json")


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(
        lambda up: np.linalg.norm(up) > 0.1
    ),
    st.floats(-80, 80),
    st.floats(0.5, 5),
)
def test_every_camera_of_an_orbit_looks_at_the_middle(up, elevation: float, distance: float) -> None:  # type: ignore[no-untyped-def]
    positions = np.random.default_rng(0).normal((5.0, -2.0, 1.0), 1.0, (500, 3))
    middle = np.median(positions, axis=0)
    cameras = orbit(positions, frames=7, width=64, height=48, up=up, elevation=elevation, distance=distance)
    direction = np.asarray(up) / np.linalg.norm(up)
    distances = [np.linalg.norm(camera.center - middle) for _, camera in cameras]
    np.testing.assert_allclose(distances, distances[0], rtol=1e-9)
    for _, camera in cameras:
        x, y, z = camera.rotation @ middle + camera.translation
        assert z > 0
        assert abs(camera.fx * x / z) < 1e-6
        assert abs(camera.fy * y / z) < 1e-6
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(camera.rotation) > 0
        assert camera.rotation[1] @ direction < 0  # the image's y axis points down
        height = (camera.center - middle) @ direction / np.linalg.norm(camera.center - middle)
        assert np.arcsin(height) == pytest.approx(np.deg2rad(elevation), abs=1e-6)


def test_cameras_between_others_look_as_their_neighbours_do() -> None:
    positions = np.random.default_rng(0).normal(size=(50, 3))
    ring = [camera for _, camera in orbit(positions, frames=12, width=64, height=48)]
    more = between(ring, 40)
    assert len(more) == 40
    middle = np.mean([camera.center for camera in ring], axis=0)
    radius = np.linalg.norm(ring[0].center - middle)
    step = np.linalg.norm(ring[0].center - ring[1].center)
    centers = np.stack([camera.center for camera in ring])
    for camera in more:
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert (camera.fx, camera.width, camera.height) == (ring[0].fx, 64, 48)
        # Between neighbours, at most two steps apart, and a little aside.
        assert np.linalg.norm(centers - camera.center, axis=1).min() < 1.2 * step
        assert 0.5 * radius < np.linalg.norm(camera.center - middle) < 1.5 * radius
        nearest = ring[np.linalg.norm(centers - camera.center, axis=1).argmin()]
        assert camera.rotation[2] @ nearest.rotation[2] > np.cos(np.deg2rad(75))
    distances = np.linalg.norm(centers[:, None] - np.stack([c.center for c in more]), axis=2).min(0)
    assert np.median(distances) > 0.1 * step  # they are not those that were there


def test_cameras_between_two_that_are_turned_by_little_less_and_more_than_half_a_turn_are_turned_by_half() -> (
    None
):
    # Their quaternions have opposite signs, the mean of which would be no turn at all.
    def turned(degrees: float) -> Camera:
        angle = np.deg2rad(degrees)
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        return Camera(pose, 10.0, 10.0, 4.0, 4.0, 8, 8)

    for camera in between([turned(179), turned(181)], 6):
        np.testing.assert_allclose(camera.rotation, turned(180).rotation, atol=np.deg2rad(1))


def test_cameras_between_are_the_same_every_time_and_others_for_another_seed() -> None:
    ring = [camera for _, camera in orbit(np.eye(3), frames=5, width=8, height=8)]
    poses = [np.stack([c.world_to_camera for c in between(ring, 6, seed=seed)]) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert not np.allclose(poses[0], poses[2])


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_cameras_have_others_between_them(count: int) -> None:
    ring = [camera for _, camera in orbit(np.eye(3), frames=5, width=8, height=8)][:count]
    more = between(ring, 4)
    assert len(more) == 4 and all(np.isfinite(camera.world_to_camera).all() for camera in more)
    if count == 1:
        np.testing.assert_allclose(more[0].world_to_camera, ring[0].world_to_camera, atol=1e-12)


def test_the_circle_is_around_three_quarters_of_the_positions() -> None:
    """Of a hundred positions, eighty lie one unit from the middle, the others far off in the background."""
    chance = np.random.default_rng(0)
    directions = chance.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near, far = directions[:40], 60 * directions[40:]
    middle = np.array([1.0, 2.0, 3.0])
    positions = middle + np.concatenate([near, -near, far, -far])
    for _, camera in orbit(positions, frames=4, width=64, height=48, elevation=30.0, distance=2.0):
        away = camera.center - middle
        assert np.linalg.norm(away) == pytest.approx(2.0, rel=0.05)
        assert -away[1] == pytest.approx(1.0, rel=0.1)  # up is -y


def share_in_view(positions: np.ndarray, cameras: list[tuple[str, Camera]]) -> float:
    """The least of the shares of positions that the cameras have in their pictures."""
    shares = []
    for _, camera in cameras:
        x, y, depth = camera.rotation @ positions.T + camera.translation[:, None]
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        inside = (depth > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        shares.append(float(inside.mean()))
    return min(shares)


@pytest.mark.parametrize("size", [(640, 480), (300, 900)])
def test_an_object_is_whole_in_the_pictures_and_a_capture_is_seen_from_where_it_was(
    size: tuple[int, int],
) -> None:
    width, height = size
    tall = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * (0.3, 1.0, 0.3) + (5, 6, 7)
    at = {"width": width, "height": height}
    assert share_in_view(tall, whole(tall, frames=12, **at)) > 0.98
    distance = distance_of_all(tall, **at)
    if distance > USUAL_DISTANCE:
        assert share_in_view(tall, orbit(tall, frames=12, **at, distance=0.8 * distance)) < 0.98
    far = np.random.default_rng(1).normal(size=(600, 3)) * 40
    assert distance_of_all(np.concatenate([tall, far]), **at) == USUAL_DISTANCE
