import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.numerics.rotations import rigid
from compgs.scene import Points
from compgs.scene.points import (
    COORDINATE_BITS,
    fallback_points,
    median_spacing,
    neighbour_distance,
    voxel_grid,
)


def points_at(positions: np.ndarray) -> Points:
    return Points(positions.astype(np.float32), np.zeros((len(positions), 3), dtype=np.uint8))


def ring(count: int, radius: float) -> list[Camera]:
    """Cameras around (1, 2, 3), looking at it."""
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        center = np.array([1.0, 2.0, 3.0]) + radius * np.array([np.cos(angle), np.sin(angle), 0.0])
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        rotation = np.stack([np.cross(down, forward), down, forward])
        cameras.append(Camera(rigid(rotation, -rotation @ center), 50.0, 50.0, 30.0, 20.0, 60, 40))
    return cameras


@given(
    arrays(np.float32, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-100, 100, width=32)),
    st.floats(0.01, 10),
)
def test_every_point_has_its_voxel_and_every_voxel_a_point(positions: np.ndarray, size: float) -> None:
    coordinates, found = voxel_grid(points_at(positions), size)
    assert found == size
    assert coordinates.dtype == np.int32
    expected = {tuple(round(float(c) / size) for c in p) for p in positions.astype(np.float64)}
    assert {tuple(row) for row in coordinates.tolist()} == expected
    assert len(coordinates) == len(expected)


def test_the_voxel_size_is_the_median_distance_of_neighbours() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.25] * 3), axis=-1).reshape(-1, 3)
    coordinates, size = voxel_grid(points_at(grid))
    assert size == pytest.approx(0.25)
    assert len(coordinates) == len(grid)


def test_copies_and_outliers_do_not_move_the_voxel_size() -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.arange(8) * 0.5] * 3), axis=-1).reshape(-1, 3)
    disturbed = np.concatenate([grid, np.repeat(grid[:50], 30, axis=0), rng.normal(size=(40, 3)) * 1e4])
    assert median_spacing(disturbed) == pytest.approx(0.5)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_still_give_a_grid(count: int) -> None:
    positions = np.arange(3 * count, dtype=np.float64).reshape(count, 3)
    coordinates, size = voxel_grid(points_at(positions))
    assert coordinates.shape == (count, 3)
    assert size > 0


def test_one_place_many_times_gives_one_voxel() -> None:
    coordinates, _ = voxel_grid(points_at(np.ones((50, 3))))
    assert len(coordinates) == 1


def test_a_voxel_size_that_leaves_the_range_is_refused_with_one_that_fits() -> None:
    positions = np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 0.0]])
    with pytest.raises(ConfigError, match=r"voxel size 0\.0001.*at least 0\.000954"):
        voxel_grid(points_at(positions), 1e-4)


def test_a_few_points_beyond_the_range_are_left_out() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(6) * 1e-3] * 3), axis=-1).reshape(-1, 3)
    far = np.concatenate([grid, [[1e5, 0, 0]]])
    for chosen in (None, 1e-3):
        coordinates, size = voxel_grid(points_at(far), chosen)
        assert size == pytest.approx(1e-3)
        assert len(coordinates) == len(grid)
        assert np.abs(coordinates).max() < 1 << (COORDINATE_BITS - 1)


def test_a_scene_far_from_the_origin_is_refused() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.5] * 3), axis=-1).reshape(-1, 3) + 4e6
    with pytest.raises(ConfigError, match="from the origin"):
        voxel_grid(points_at(grid), 0.25)
    with pytest.raises(ConfigError, match="from the origin"):
        voxel_grid(points_at(grid))


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_voxel_sizes_are_refused(size: float) -> None:
    with pytest.raises(ConfigError, match="voxel size"):
        voxel_grid(points_at(np.ones((3, 3))), size)


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 12), st.floats(0.1, 100), st.integers(0, 1000))
def test_random_points_lie_where_cameras_look(count: int, radius: float, seed: int) -> None:
    cameras = ring(count, radius)
    positions = fallback_points(cameras, 300, seed).positions.astype(np.float64)
    assert positions.shape == (300, 3)
    seen = np.zeros(300, dtype=int)
    for camera in cameras:
        x, y, z = (positions @ camera.rotation.T + camera.translation).T
        z = np.where(z > 0, z, np.nan)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        seen += (u > -0.01) & (u < camera.width + 0.01) & (v > -0.01) & (v < camera.height + 0.01)
    assert (seen >= 1).all()
    # around what all cameras look at
    assert np.linalg.norm(np.median(positions, axis=0) - (1, 2, 3)) < radius


def test_random_points_of_two_cameras_that_face_each_other_lie_between_them() -> None:
    # Their axes are one line: nothing but their places says where on it to look.
    for seed in range(20):
        positions = fallback_points(ring(2, 0.25), 300, seed).positions
        assert np.linalg.norm(positions.mean(axis=0) - (1, 2, 3)) < 0.25


def test_random_points_depend_on_the_seed_alone() -> None:
    cameras = ring(5, 2.0)
    a, b, c = (fallback_points(cameras, 50, seed).positions for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_parallel_cameras_get_points_in_front_of_them() -> None:
    cameras = [
        Camera(rigid(np.eye(3), np.array([-i, 0.0, 0.0])), 50.0, 50.0, 30.0, 20.0, 60, 40) for i in range(5)
    ]
    positions = fallback_points(cameras, 100).positions
    assert np.isfinite(positions).all()
    assert (positions[:, 2] > 0).all()


def test_the_distance_of_neighbours_is_that_of_the_three_nearest_of_all() -> None:
    points = np.random.default_rng(4).normal(size=(60, 3))
    every = np.linalg.norm(points[:, None] - points[None], axis=2)
    three = np.sort(every, axis=1)[:, 1:4]
    np.testing.assert_allclose(neighbour_distance(points), np.sqrt((three**2).mean(axis=1)))
    assert neighbour_distance(points[:1]).tolist() == [1.0]
    assert neighbour_distance(points[:2]) == pytest.approx(np.full(2, every[0, 1]))
