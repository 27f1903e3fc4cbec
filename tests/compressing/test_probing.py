"""What a small picture says of a place."""

from dataclasses import replace

import numpy as np

from compgs.cameras import Camera
from compgs.compressing.probing import probe, standing_in
from compgs.evaluation.camera_path import look_at
from compgs.gaussians import Gaussians
from compgs.numerics.rotations import rotation_from_quaternion
from compgs.render import rasterize

UP = np.array([0.0, -1.0, 0.0])


def camera_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    return Camera(look_at(np.array(eye), np.array(target), UP), 80.0, 80.0, 40.0, 30.0, 80, 60)


def test_what_is_covered_is_what_the_picture_of_white_splats_shows(ball) -> None:
    camera = camera_at((3, 0, -4), (3, 0, 0))
    gaussians = ball.model.gaussians(camera)
    white = replace(gaussians, colors=np.ones_like(gaussians.colors))
    shown = float(rasterize(white, camera).image.mean())
    assert 0.05 < shown < 0.9
    np.testing.assert_allclose(probe(ball.model, camera).covered, shown, rtol=1e-4)


def test_a_place_is_in_a_splat_up_to_three_deviations_along_its_own_axes() -> None:
    rng = np.random.default_rng(0)
    count = 300
    means, scales = rng.normal(size=(count, 3)), np.exp(rng.normal(size=(count, 3)))
    turns, place = rng.normal(size=(count, 4)), np.array([0.3, -0.2, 0.5])
    expected = []
    for mean, scale, turn in zip(means, scales, turns, strict=True):
        rotation = rotation_from_quaternion(turn)
        covariance = rotation @ np.diag(scale**2) @ rotation.T
        expected.append((place - mean) @ np.linalg.inv(covariance) @ (place - mean) < 9.0)
    found = standing_in(Gaussians(means, turns, scales, np.ones(count), np.ones((count, 3))), place)
    assert 20 < sum(expected) < 280
    assert found.tolist() == expected


def test_a_place_in_a_wall_is_not_open_and_one_before_it_is(room) -> None:
    assert not probe(room.model, camera_at((0, 0, 2.1), (0, 0, -2))).open
    before = probe(room.model, camera_at((0, 0, -1.0), (0, 0, -2)))
    assert before.open and before.good and before.covered > 0.85


def test_an_empty_picture_is_open_but_no_good(ball) -> None:
    away = probe(ball.model, camera_at((3, 0, -4), (3, 0, -9)))
    assert away.open and not away.good


def test_a_model_far_from_the_origin_is_seen_by_cameras_of_the_world(ball) -> None:
    offset = (1e5, -2e5, 3e5)
    far = ball.model.at(offset)
    camera = camera_at((3, 0, -4), (3, 0, 0))
    there = camera.moved(tuple(-x for x in offset))
    np.testing.assert_allclose(probe(far, there).covered, probe(ball.model, camera).covered, rtol=1e-5)
