"""Color that depends on the direction of view: real spherical harmonics of degree 0 to 3 (3DGS, Kerbl et al. 2023).

    color(d) = max(0, 1/2 + Y_0 dc + sum_k Y_k(d) rest_k),    d = (mean - camera centre) / |mean - camera centre|

Order and signs are those of 3DGS files: bands l = 0, 1, 2, 3, in each m = -l ... l; Y carries the Condon-Shortley phase
(-1)^m, so that Y_1 = sqrt(3 / 4 pi) (-y, z, -x). A file looks the same here as in other viewers only because of it.

On numpy arrays; `tensors/spherical_harmonics.py` has the same on torch tensors, in any precision and on any device.
"""

from typing import Any, cast

import numpy as np

from compgs.gaussians import Array
from compgs.model import spherical_harmonics_kernels as kernels
from compgs.model.degrees import degree_of
from compgs.model.spherical_harmonics_kernels import (
    Y0,
    Y1,
    Y2_XX,
    Y2_XY,
    Y2_Z,
    Y3_1,
    Y3_3,
    Y3_XYZ,
    Y3_Z,
    Y3_ZXX,
)

COLOR_OFFSET = 0.5  # gray, where all coefficients are zero


def harmonics(x: Array, y: Array, z: Array, degree: int) -> list[Array]:  # each [M], of unit vectors
    """The basis functions of degree 1 to `degree` in the order of the file, each [M]; of arrays or tensors alike."""
    a, b, c = cast("tuple[Any, Any, Any]", (x, y, z))
    values = [-Y1 * b, Y1 * c, -Y1 * a] if degree >= 1 else []
    aa, bb, cc = a * a, b * b, c * c
    if degree >= 2:
        values += [Y2_XY * a * b, -Y2_XY * b * c, Y2_Z * (2 * cc - aa - bb)]
        values += [-Y2_XY * a * c, Y2_XX * (aa - bb)]
    if degree >= 3:
        values += [-Y3_3 * b * (3 * aa - bb), Y3_XYZ * a * b * c, -Y3_1 * b * (4 * cc - aa - bb)]
        values += [Y3_Z * c * (2 * cc - 3 * aa - 3 * bb), -Y3_1 * a * (4 * cc - aa - bb)]
        values += [Y3_ZXX * c * (aa - bb), -Y3_3 * a * (aa - 3 * bb)]
    return values


def harmonic_basis(directions: np.ndarray, degree: int) -> np.ndarray:  # [M, 3] unit -> [M, (degree + 1)^2]
    """The basis functions, with that of degree 0, in the precision of the directions."""
    x, y, z = directions.T
    return np.stack([np.full_like(x, Y0), *harmonics(x, y, z, degree)], 1)


def view_colors(
    means: np.ndarray,  # [M, 3] float32, world units
    dc: np.ndarray,  # [M, 3] float32, coefficients of degree 0
    rest: np.ndarray,  # [M, K, 3] float32, of the degrees above; all are used
    center: np.ndarray,  # [3] of the camera, world units
) -> np.ndarray:  # [M, 3] float32, display RGB, not below 0
    """What a camera sees of each splat."""
    means, dc, rest = (np.require(a, np.float32, ("C", "W")) for a in (means, dc, rest))
    degree = degree_of(rest.shape[1])
    colors = np.empty_like(means)
    kernels.view_colors(
        means, dc, rest, center.astype(np.float32), np.ones(len(means), np.bool_), degree, colors
    )
    return colors


def view_colors_gradient(
    means: np.ndarray,  # [M, 3] float32, world units
    rest: np.ndarray,  # [M, K, 3] float32
    center: np.ndarray,  # [3] of the camera, world units
    colors: np.ndarray,  # [M, 3] from `view_colors`
    d_colors: np.ndarray,  # [M, 3] gradient by them
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients by the coefficients of degree 0 [M, 3] and above [M, K, 3]."""
    means, rest = (np.require(a, np.float32, ("C", "W")) for a in (means, rest))
    degree = degree_of(rest.shape[1])
    d_means, d_dc, d_rest = np.empty_like(means), np.empty_like(means), np.empty_like(rest)
    center = center.astype(np.float32)
    kernels.view_colors_gradient(
        means, rest, center, degree, colors, np.ascontiguousarray(d_colors), d_means, d_dc, d_rest
    )
    return d_dc, d_rest
