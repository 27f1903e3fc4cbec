"""Unit quaternions (w-x-y-z) and rotation matrices, in float64."""

import numpy as np


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """[4] w-x-y-z, not zero, of any length -> [3, 3]."""
    # scaled by the largest part first: the squares of very small or large parts would leave float64
    w, x, y, z = (scaled := quaternion / np.abs(quaternion).max()) / np.linalg.norm(scaled)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """[3, 3] -> [4] w-x-y-z with w >= 0.

    The outer product q q^T is linear in the rotation; its longest row is q times its largest part, which is
    never small: no case distinction loses digits.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    outer = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = outer[np.argmax(np.diag(outer))]
    quaternion = row / np.linalg.norm(row)
    return -quaternion if quaternion[0] < 0 else quaternion


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] with positive determinant -> the closest rotation: without uniform scale and rounding."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """[3, 3] and [3] -> [4, 4] float64."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix
