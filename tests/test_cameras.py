"""Cameras, moved from one frame to another."""

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.evaluation.camera_path import look_at

POSE = look_at(np.array([3.0, -1.0, 2.0]), np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
CAMERA = Camera(POSE, 50.0, 51.0, 24.0, 18.0, 48, 36)


def test_a_moved_camera_sees_points_where_it_saw_them() -> None:
    origin = np.array([4.2e6, -5.1e5, 3e3])
    points = np.random.default_rng(0).normal(size=(20, 3))
    far = CAMERA.moved(-origin)  # the camera in a world in which everything lies `origin` further
    np.testing.assert_allclose(far.center, CAMERA.center + origin, rtol=0, atol=1e-8)
    seen = (points + origin) @ far.rotation.T + far.translation
    np.testing.assert_allclose(seen, points @ CAMERA.rotation.T + CAMERA.translation, rtol=0, atol=1e-8)
    back = far.moved(origin)
    np.testing.assert_allclose(back.world_to_camera, POSE, rtol=0, atol=1e-8)
    assert (back.fx, back.cy, back.width) == (50.0, 18.0, 48)


def test_a_camera_moved_by_one_hand_made_step() -> None:
    """Turned by 90 degrees about z: what is 2 along x in the world is 2 along y for the camera."""
    turned = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]])
    camera = Camera(turned, 1.0, 1.0, 0.5, 0.5, 1, 1)
    assert camera.moved((2.0, 0.0, -1.0)).translation.tolist() == [0.0, 2.0, 4.0]
    assert camera.translation.tolist() == [0.0, 0.0, 5.0]


@pytest.mark.parametrize("zero", [(0.0, 0.0, 0.0), -np.zeros(3)])
def test_a_camera_that_stays_is_the_same_object(zero: object) -> None:
    assert CAMERA.moved(zero) is CAMERA
