"""The few cameras that stand for all, and the direction of the sky."""

import numpy as np
import pytest

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.numerics.rotations import rigid
from compgs.scene.viewpoints import choose_viewpoints, up_direction


def looking(center: np.ndarray, target: np.ndarray, up: np.ndarray, roll: float = 0.0) -> Camera:
    """A camera at `center` that sees `target`, `up` upwards in its image, turned by `roll` radians about its axis."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    turned = np.stack(
        [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward]
    )
    return Camera(rigid(turned, -turned @ center), 50.0, 50.0, 24.0, 18.0, 48, 36)


UP = np.array([0.0, 0.6, 0.8])


def ring(count: int, offset: float = 0.0) -> list[Camera]:
    """On a circle in the plane across UP."""
    side, front = np.array([1.0, 0, 0]), np.cross(UP, [1.0, 0, 0])
    angles = 2 * np.pi * np.arange(count) / count
    return [
        looking(3 * (np.cos(a) * side + np.sin(a) * front) + UP + offset, np.zeros(3) + offset, UP)
        for a in angles
    ]


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("count", [24, 40])
def test_four_of_a_ring_are_evenly_spaced(count: int, offset: float) -> None:
    chosen = sorted(choose_viewpoints(ring(count, offset), 4))
    assert np.diff([*chosen, chosen[0] + count]).tolist() == [count // 4] * 4


def test_the_smaller_of_two_clusters_is_represented_first() -> None:
    rng = np.random.default_rng(0)
    centers = np.concatenate([rng.normal(0, 0.1, (50, 3)), rng.normal((9.0, 0, 0), 0.1, (3, 3))])
    cameras = [looking(c, c + np.array([0.0, 1, 0]), UP) for c in centers]
    first, second = choose_viewpoints(cameras, 2)
    assert first < 50 <= second
    mean = centers.mean(axis=0)
    assert first == np.linalg.norm(centers - mean, axis=1).argmin()


def test_cameras_in_one_place_are_told_apart_by_where_they_look() -> None:
    here = np.array([100.0, 200.0, 300.0])
    ways = [*[[1.0, 0.01 * i, 0] for i in range(9)], [-1.0, 0, 0], [0, 1.0, 0]]
    cameras = [looking(here, here + np.array(way), np.array([0.0, 0, 1])) for way in ways]
    assert set(choose_viewpoints(cameras, 3)) >= {9, 10}


def test_the_choice_does_not_depend_on_units_or_on_the_place_in_the_world() -> None:
    rng = np.random.default_rng(1)
    centers, targets = rng.normal(size=(30, 3)), rng.normal(size=(30, 3)) * 0.1
    expected = choose_viewpoints([looking(c, t, UP) for c, t in zip(centers, targets, strict=True)], 8)
    for scale, shift in ((1000.0, 0.0), (0.001, 0.0), (1.0, 1e6)):
        cameras = [
            looking(scale * c + shift, scale * t + shift, UP) for c, t in zip(centers, targets, strict=True)
        ]
        assert choose_viewpoints(cameras, 8) == expected


def test_all_are_chosen_once_where_there_are_no_more() -> None:
    cameras = ring(5) + ring(5)  # in pairs at the same places
    chosen = choose_viewpoints(cameras, 99)
    assert sorted(chosen) == list(range(10))
    assert {i % 5 for i in chosen[:5]} == set(range(5))
    assert choose_viewpoints(cameras, 3) == chosen[:3]
    for bad in ((cameras, 0), ([], 4)):
        with pytest.raises(ConfigError, match="viewpoints"):
            choose_viewpoints(*bad)


def test_up_is_what_is_up_in_the_images() -> None:
    np.testing.assert_allclose(up_direction(ring(12)), UP, atol=1e-9)
    # Cameras that look down onto the middle from different heights still agree in the mean.
    tilted = [
        looking(np.array([np.cos(a), np.sin(a), 2.0]), np.zeros(3), np.array([0, 0, 1.0])) for a in range(7)
    ]
    x, y, z = up_direction(tilted)
    assert z > 0.9 and np.hypot(x, y) < 0.3
    assert np.linalg.norm((x, y, z)) == pytest.approx(1)


def test_above_a_landscape_up_is_where_the_cameras_come_from() -> None:
    down = [
        looking(np.array([i, 0.0, 100.0]), np.array([i, 0.0, 0.0]), np.array([0, 1.0, 0]), roll=np.pi * i)
        for i in range(6)
    ]
    np.testing.assert_allclose(up_direction(down), [0, 0, 1], atol=1e-9)


def test_where_nothing_tells_up_from_down_it_is_colmaps_usual() -> None:
    both = [
        looking(np.zeros(3), np.array([0.0, 0, side]), np.array([0, 1.0, 0]), roll=roll)
        for side in (1, -1)
        for roll in (0.0, np.pi)
    ]
    assert up_direction(both) == (0.0, -1.0, 0.0)
