"""Other axes: the same ellipsoids and colors, looked at from elsewhere."""

import numpy as np
import pytest

from compgs.formats.arrays import Y0, SplatArrays, normalized
from compgs.formats.frames import (
    LEFT_UP_FORWARD,
    RIGHT_UP_BACK,
    basis,
    rotated_harmonics,
    transformed,
    turned,
)
from compgs.numerics.rotations import rotation_from_quaternion


def covariances(arrays: SplatArrays) -> np.ndarray:
    turns = np.stack([rotation_from_quaternion(q) for q in normalized(arrays.quaternions)])
    axes = turns * np.exp(arrays.log_scales.astype(np.float64))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def colors(arrays: SplatArrays, direction: np.ndarray) -> np.ndarray:
    """[M, 3] as seen along a direction, not clamped."""
    values = basis(direction[None], arrays.degree)[0]
    return 0.5 + Y0 * arrays.dc + np.einsum("k,mkc->mc", values[1:], arrays.rest)


def some_rotation(seed: int = 5) -> np.ndarray:
    return rotation_from_quaternion(np.random.default_rng(seed).normal(size=4))


@pytest.mark.parametrize("signs", [RIGHT_UP_BACK, LEFT_UP_FORWARD])
def test_half_a_turn_moves_ellipsoids_and_colors_with_the_axes(made, signs: tuple[int, int, int]) -> None:
    arrays = made(6)
    other = turned(arrays, signs)
    flip = np.diag(signs)
    np.testing.assert_array_equal(other.means, arrays.means * np.array(signs))
    np.testing.assert_allclose(covariances(other), flip @ covariances(arrays) @ flip, rtol=1e-6, atol=1e-9)
    direction = np.array([0.6, -0.3, 0.2])
    direction /= np.linalg.norm(direction)
    np.testing.assert_allclose(colors(other, flip @ direction), colors(arrays, direction), atol=1e-6)


@pytest.mark.parametrize("signs", [RIGHT_UP_BACK, LEFT_UP_FORWARD])
def test_two_half_turns_are_none_to_the_bit(made, signs: tuple[int, int, int]) -> None:
    arrays = made(6)
    again = turned(turned(arrays, signs), signs)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "dc", "rest"):
        np.testing.assert_array_equal(getattr(again, name), getattr(arrays, name))
    assert again.world_offset == arrays.world_offset


def test_where_positions_count_from_turns_along(made) -> None:
    arrays = made(2)
    far = SplatArrays(**{**vars(arrays), "world_offset": (3.0, 4.0, 5.0)})
    assert turned(far, LEFT_UP_FORWARD).world_offset == (-3.0, -4.0, 5.0)


def test_harmonics_of_degree_one_turn_like_a_vector() -> None:
    rotation = some_rotation()
    rest = np.random.default_rng(0).normal(size=(4, 3, 3))
    # Y_1 = sqrt(3 / 4 pi) (-y, z, -x): the coefficients are those of the vector (-c2, -c0, c1).
    vectors = np.stack([-rest[:, 2], -rest[:, 0], rest[:, 1]], 1)
    after = np.einsum("ij,mjc->mic", rotation, vectors)
    expected = np.stack([-after[:, 1], after[:, 2], -after[:, 0]], 1)
    np.testing.assert_allclose(rotated_harmonics(rest, rotation), expected, atol=1e-12)


@pytest.mark.parametrize("l", [1, 2, 3])
def test_about_the_axis_harmonics_turn_by_multiples_of_the_angle(l: int) -> None:
    angle = 0.7
    c, s = np.cos(angle), np.sin(angle)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    rest = np.zeros((1, 15, 3))
    first = l * l - 1  # m = -l
    rest[0, first : first + 2 * l + 1, 0] = np.arange(1, 2 * l + 2)
    found = rotated_harmonics(rest, about_z)[0, first : first + 2 * l + 1, 0]
    expected = np.zeros(2 * l + 1)
    for m in range(-l, l + 1):
        # Y_m ~ cos(m phi), Y_-m ~ sin(m phi) for m > 0, of equal signs: f'(phi) = f(phi - angle).
        k = abs(m)
        plus, minus = rest[0, first + l + k, 0], rest[0, first + l - k, 0]
        cosine, sine = np.cos(k * angle), np.sin(k * angle)
        expected[l + m] = plus * cosine - minus * sine if m >= 0 else plus * sine + minus * cosine
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert not np.delete(rotated_harmonics(rest, about_z)[0, :, 0], range(first, first + 2 * l + 1)).any()


def test_a_place_in_a_scene_moves_ellipsoids_and_colors(made) -> None:
    arrays, rotation, scale = made(5), some_rotation(), 2.5
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, [10.0, 20.0, 30.0]
    other = transformed(arrays, matrix)
    np.testing.assert_allclose(other.means, scale * arrays.means @ rotation.T, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(other.world_offset, [10, 20, 30])
    expected = scale**2 * rotation @ covariances(arrays) @ rotation.T
    np.testing.assert_allclose(covariances(other), expected, rtol=1e-4, atol=1e-7)
    direction = np.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(colors(other, rotation @ direction), colors(arrays, direction), atol=1e-5)
