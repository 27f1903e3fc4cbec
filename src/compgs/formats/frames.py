"""Splats in another frame: axes that point elsewhere, and rotations, with their harmonics.

The world here has COLMAP's axes (x right, y down, z forward), as files of 3DGS do. Where other axes lie along these,
only signs change, so that going there and back loses nothing.

| convention | x, y, z | half a turn about | files |
|---|---|---|---|
| here | right, down, forward | | .ply, .splat, .sog |
| OpenGL, three.js | right, up, back | x | .spz |
| glTF | left, up, forward | z | .glb |
"""

from dataclasses import replace

import numpy as np

from compgs.formats.arrays import SplatArrays, degree_of
from compgs.numerics.rotations import nearest_rotation, quaternion_from_rotation

RIGHT_UP_BACK = (1, -1, -1)
LEFT_UP_FORWARD = (-1, -1, 1)

# Which of x, y, z each harmonic of degree 1 to 3 is odd in: it changes sign where an odd number of those do.
_ODD_IN = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")


def turned(arrays: SplatArrays, signs: tuple[int, int, int]) -> SplatArrays:
    """Splats where some axes point the other way: of two, half a turn; of one or three, a mirror. Its own inverse, to
    the bit."""
    assert set(signs) <= {1, -1}, signs
    s = np.array(signs, np.float32)
    odd = [np.prod([s["xyz".index(axis)] for axis in axes]) for axes in _ODD_IN]
    return replace(
        arrays,
        means=arrays.means * s,
        # D R D in place of D R: the ellipsoid R S^2 R^T is the same, for D S D = S. It turns also where D mirrors.
        quaternions=arrays.quaternions * np.append(np.float32(1), np.prod(s) * s),
        rest=arrays.rest * np.array(odd, np.float32)[: arrays.rest.shape[1], None],
        world_offset=tuple((np.array(arrays.world_offset) * s + 0.0).tolist()),
    )


# Where a letter points to, along which of the axes here.
_DIRECTIONS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "D": (0, 1, 0),
    "U": (0, -1, 0),
    "F": (0, 0, 1),
    "B": (0, 0, -1),
}


def from_axes(arrays: SplatArrays, letters: str) -> SplatArrays:
    """Splats whose x, y, z point to what the letters name (Right, Left, Up, Down, Front, Back), in the axes here."""
    linear = np.array([_DIRECTIONS[letter] for letter in letters]).T
    if not np.any(linear - np.diag(np.diag(linear))):
        x, y, z = (int(sign) for sign in np.diag(linear))
        return turned(arrays, (x, y, z))
    side = round(float(np.linalg.det(linear)))
    matrix = np.eye(4)
    matrix[:3, :3] = linear * (side, 1, 1)  # a rotation: of left-handed axes, x is turned over first
    return transformed(turned(arrays, (side, 1, 1)), matrix)


def transformed(arrays: SplatArrays, matrix: np.ndarray) -> SplatArrays:
    """Splats after a rotation, a uniform scale and a translation, [4, 4]; the translation goes to `world_offset`."""
    linear = matrix[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    rotation = nearest_rotation(linear / scale)
    w, xyz = np.split(quaternion_from_rotation(rotation), [1])
    qw, qxyz = np.split(arrays.quaternions.astype(np.float64), [1], axis=1)
    turned_by = np.hstack([w * qw - qxyz @ xyz[:, None], w * qxyz + qw * xyz + np.cross(xyz, qxyz)])
    offset = linear @ np.array(arrays.world_offset) + matrix[:3, 3]
    return replace(
        arrays,
        means=(arrays.means @ linear.T).astype(np.float32),
        log_scales=(arrays.log_scales + np.log(scale)).astype(np.float32),
        quaternions=turned_by.astype(np.float32),
        rest=rotated_harmonics(arrays.rest, rotation),
        world_offset=tuple(offset.tolist()),
    )


def rotated_harmonics(rest: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Coefficients [M, K, 3] of the functions turned by a rotation [3, 3]: f'(d) = f(R^T d).

    Each degree turns within itself, by a matrix that its values in a few directions determine.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degree = degree_of(rest.shape[1])
    before, after = basis(directions @ rotation, degree), basis(directions, degree)
    result = np.empty_like(rest)
    for l in range(1, degree + 1):
        band = slice(l * l - 1, (l + 1) ** 2 - 1)  # of `rest`, which has no degree 0
        columns = slice(l * l, (l + 1) ** 2)
        turn = np.linalg.lstsq(after[:, columns], before[:, columns], rcond=None)[0]
        result[:, band] = np.einsum("ij,mjc->mic", turn, rest[:, band])
    return result


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """`compgs.model.spherical_harmonics.harmonic_basis` of unit vectors [N, 3], in float64."""
    from compgs.model.spherical_harmonics import harmonic_basis  # loads numba, which few files need

    return harmonic_basis(directions.astype(np.float64), degree)
