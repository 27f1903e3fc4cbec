"""Distances of what is seen, against closed forms."""

import math

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.model.splats import SplatArrays, SplatModel
from compgs.render.depth import depth

WIDTH, HEIGHT = 40, 30


def walls(*given: tuple[float, float], offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SplatModel:
    """Flat splats across the whole picture, at distances, with opacities."""
    n = len(given)
    return SplatModel(
        SplatArrays(
            means=np.array([[0.0, 0.0, z] for z, _ in given]),
            log_scales=np.full((n, 3), math.log(500.0)) - np.array([[0.0, 0.0, 15.0]]),
            quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            opacity_logits=np.array([math.log(p / (1 - p)) for _, p in given]),
            dc=np.zeros((n, 3)),
            rest=np.zeros((n, 0, 3)),
            world_offset=offset,
        ).each(np.float32),
        background=(1.0, 0.5, 0.0),
    )


def camera(x: float = 0.0) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(pose, 50.0, 50.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def test_the_distance_of_what_hides_all_else_is_its_own() -> None:
    found = depth(walls((7.0, 0.99999), (5.0, 0.99999), (9.0, 0.9)), camera())
    assert found.shape == (HEIGHT, WIDTH)
    # The cap lets a thousandth of what is behind through.
    assert found == pytest.approx(np.full((HEIGHT, WIDTH), 5.0), abs=0.005)


def test_what_shines_through_counts_by_its_share_and_the_background_does_not() -> None:
    found = depth(walls((4.0, 0.5), (8.0, 0.5)), camera())
    assert found == pytest.approx(np.full((HEIGHT, WIDTH), (0.5 * 4 + 0.25 * 8) / 0.75), rel=1e-3)


def test_where_the_background_shows_the_distance_is_infinite() -> None:
    assert np.isinf(depth(walls((4.0, 0.4)), camera())).all()


def test_cameras_are_of_the_world_and_scenes_of_their_own_frame() -> None:
    found = depth(walls((5.0, 0.9), offset=(1000.0, 0.0, 20.0)), camera(1000.0))
    assert found == pytest.approx(np.full((HEIGHT, WIDTH), 25.0), rel=1e-3)
