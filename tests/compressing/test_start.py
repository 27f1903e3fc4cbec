"""Where anchors start: about as many as asked for, where splats are seen, in their colors."""

import numpy as np

from compgs.cameras import Camera
from compgs.compressing.start import seen_weights, start_points, voxel_size_for
from compgs.model.splats import SplatModel
from compgs.scene.points import voxel_grid


def test_there_are_about_as_many_voxels_as_asked_for() -> None:
    means = np.random.default_rng(0).uniform(-3, 3, (2000, 3))
    for wanted in (20, 150, 900):
        size = voxel_size_for(means, wanted)
        count = len({tuple(row) for row in np.round(means / size).astype(int).tolist()})
        assert 0.85 * wanted <= count <= wanted


def test_each_point_becomes_one_anchor(ball) -> None:
    points, size = start_points(ball.model, np.ones(312), 80)
    coordinates, used = voxel_grid(points, size)
    assert used == size and len(coordinates) == len(points) and 60 <= len(points) <= 80


def test_a_voxel_has_the_mean_color_of_its_splats(make_splats) -> None:
    splats = make_splats(np.array([[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0]]), 0.1)
    splats.dc[:] = np.array([[0.2, 0.0, 0.0], [-0.2, 0.4, 0.0], [0.0, 0.0, 0.0]])
    points, _ = start_points(SplatModel(splats, (0.0, 0.0, 0.0)), np.array([3.0, 1.0, 1.0]), 2)
    expected = 0.5 + 0.28209479177387814 * (0.75 * np.array([0.2, 0, 0]) + 0.25 * np.array([-0.2, 0.4, 0]))
    row = np.argmin(points.positions[:, 0])
    np.testing.assert_allclose(points.colors[row] / 255, expected, atol=1 / 255)


def test_splats_that_no_camera_sees_start_no_anchors(make_splats) -> None:
    model = SplatModel(make_splats(np.array([[0.0, 0, 2], [0.3, 0, 2], [0, 0, -2]]), 0.1), (0.0, 0.0, 0.0))
    camera = Camera(np.eye(4), 80, 80, 40, 30, 80, 60)  # looks along z
    weights = seen_weights(model, [camera, camera])
    assert weights[0] > 1 and weights[1] > 1 and weights[2] == 0
    points, _ = start_points(model, weights, 100)
    assert len(points) == 2 and points.positions[:, 2].min() > 1.9


def test_a_given_voxel_size_is_used(ball) -> None:
    assert start_points(ball.model, np.ones(312), 80, 0.7)[1] == 0.7


def test_points_are_of_the_world(ball) -> None:
    offset = (1e5, 0.0, -2e5)
    far = ball.model.at(offset)
    here, there = (start_points(model, np.ones(312), 80)[0].positions for model in (ball.model, far))
    np.testing.assert_allclose(there - offset, here, atol=1e-6)
