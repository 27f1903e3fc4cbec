"""A way along cameras: it passes all of them, smoothly, and looks where they look."""

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.errors import UnsupportedCamera
from compgs.evaluation.camera_path import look_at
from compgs.evaluation.tour import tour, tour_order, way_through

UP = np.array([0.0, 0.0, 1.0])


def ring(angles: np.ndarray, radius: float = 3.0) -> list[Camera]:
    """Cameras around the origin, which they look at."""
    centers = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.ones_like(angles)], 1)
    return [Camera(look_at(c, np.zeros(3), UP), 300.0, 300.0, 160.0, 120.0, 320, 240) for c in centers]


def test_a_ring_in_any_order_is_gone_around_once() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    shuffled = np.random.default_rng(3).permutation(12)
    order, closed = tour_order(ring(angles[shuffled]))
    steps = np.diff(shuffled[order], append=shuffled[order[0]]) % 12
    assert closed and (len(set(steps.tolist())) == 1) and steps[0] in (1, 11)


def test_frames_on_a_ring_keep_to_it_and_look_at_its_middle() -> None:
    cameras = ring(np.linspace(0, 2 * np.pi, 12, endpoint=False))
    views = tour(cameras, frames=60, width=640, height=480)
    assert len(views) == 60
    for _, camera in views:
        assert abs(np.linalg.norm(camera.center[:2]) - 3.0) < 0.06
        ahead = camera.rotation[2]
        to_middle = -camera.center / np.linalg.norm(camera.center)
        assert np.degrees(np.arccos(np.clip(ahead @ to_middle, -1, 1))) < 2.5
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-9)
        assert (camera.width, camera.height, camera.fx) == (640, 480, 600.0)
    pace = np.linalg.norm(np.diff([c.center for _, c in views], axis=0), axis=1)
    assert pace.max() < 1.3 * pace.min()


def test_half_a_ring_is_not_closed_through_what_nobody_has_seen() -> None:
    angles = np.linspace(0, np.pi, 9)
    shuffled = np.random.default_rng(0).permutation(9)
    order, closed = tour_order(ring(angles[shuffled]))
    assert not closed and set(np.diff(shuffled[order]).tolist()) in ({1}, {-1})
    views = tour(ring(angles), frames=20, width=320, height=240)
    assert all(camera.center[1] > -0.1 for _, camera in views)
    ends = {tuple(np.round(views[i][1].center, 6)) for i in (0, -1)}
    assert ends == {tuple(np.round(ring(angles)[i].center, 6)) for i in (0, -1)}


def test_two_cameras_and_cameras_in_one_place_have_a_way_too() -> None:
    two = ring(np.array([0.0, 0.5]))
    assert len(tour(two, frames=5, width=64, height=48)) == 5
    turning = [
        Camera(look_at(np.zeros(3), np.array([np.cos(a), np.sin(a), 0.0]), UP), 50, 50, 32, 24, 64, 48)
        for a in (0.0, 0.4, 0.8)
    ]
    views = tour(turning, frames=7, width=64, height=48)
    assert all(np.isfinite(camera.world_to_camera).all() for _, camera in views)


def test_one_camera_is_no_way() -> None:
    with pytest.raises(UnsupportedCamera, match="found 1"):
        tour(ring(np.zeros(1)), frames=3, width=64, height=48)


def turned(angle: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0), focal: float = 50.0) -> Camera:
    """Level, looking along the angle."""
    eye = np.array(center)
    pose = look_at(eye, eye + np.array([np.cos(angle), np.sin(angle), 0.0]), UP)
    return Camera(pose, focal, focal, 32, 24, 64, 48)


def test_a_way_keeps_the_order_of_its_cameras_and_ends_at_the_last() -> None:
    zigzag = [turned(0.0, (x, y, 0.0)) for x, y in ((0, 0), (4, 0), (1, 1), (5, 1))]
    way = way_through(zigzag, frames=301, width=64, height=48)
    centers = np.stack([camera.center for camera in way])
    nearest = [int(np.linalg.norm(centers - key.center, axis=1).argmin()) for key in zigzag]
    assert nearest[0] == 0 and nearest[-1] == 300 and nearest == sorted(nearest)
    for key, i in zip(zigzag, nearest, strict=True):
        np.testing.assert_allclose(centers[i], key.center, atol=0.05)


def test_turning_in_one_place_takes_its_time_on_a_way() -> None:
    way = way_through(
        [turned(0.0), turned(0.0, (4, 0, 0)), turned(1.6, (4, 0, 0))], frames=201, width=64, height=48
    )
    angles = [np.arctan2(*camera.rotation[2][1::-1]) for camera in way]
    assert max(np.abs(np.diff(angles))) < 1.6 / 90  # half of the frames turn
    assert abs(way[100].center[0] - 4.0) < 0.1 and abs(angles[100]) < 0.1 and abs(angles[150] - 0.8) < 0.02


def test_the_field_of_view_goes_from_one_camera_s_to_the_next_at_any_size() -> None:
    way = way_through(
        [turned(0.0, focal=32.0), turned(0.0, (1, 0, 0), focal=128.0)], frames=3, width=200, height=100
    )
    np.testing.assert_allclose([camera.fx for camera in way], [100.0, 200.0, 400.0])
    assert {(c.cx, c.cy, c.width, c.height) for c in way} == {(100.0, 50.0, 200, 100)}
    with pytest.raises(UnsupportedCamera, match="found 1"):
        way_through([turned(0.0)], frames=3, width=64, height=48)


def test_a_way_is_smooth_far_from_the_origin_and_where_cameras_stand_in_one_place() -> None:
    far = 4.5e6
    stops = [(far, 0, 0), (far + 1, 0, 0), (far + 1, 0, 0), (far + 2, 0, 0)]
    way = way_through([turned(0.3 * i, stop) for i, stop in enumerate(stops)], frames=91, width=64, height=48)
    centers = np.stack([camera.center for camera in way]) - (far, 0, 0)
    assert (np.diff(centers[:, 0]) > -1e-4).all()
    np.testing.assert_allclose(centers[[0, -1], 0], (0, 2), atol=1e-6)
    np.testing.assert_allclose(centers[:, 1:], 0, atol=1e-4)
