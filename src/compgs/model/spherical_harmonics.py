"""Color that depends on the direction of view: real spherical harmonics of degree 0 to 3 (3DGS, Kerbl et al. 2023).

    color(d) = max(0, 1/2 + Y_0 dc + sum_k Y_k(d) rest_k),    d = (mean - camera centre) / |mean - camera centre|

Order and signs are those of 3DGS files: bands l = 0, 1, 2, 3, in each m = -l ... l; Y carries the Condon-Shortley phase
(-1)^m, so that Y_1 = sqrt(3 / 4 pi) (-y, z, -x). A file looks the same here as in other viewers only because of it.

On the CPU, one compiled pass each way; elsewhere plain torch, with which the tests compare it.
"""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

MAX_DEGREE = 3
COLOR_OFFSET = 0.5  # gray, where all coefficients are zero

_PI = math.pi
Y0 = math.sqrt(1 / _PI) / 2
_Y1 = math.sqrt(3 / _PI) / 2
_Y2_XY, _Y2_Z, _Y2_XX = math.sqrt(15 / _PI) / 2, math.sqrt(5 / _PI) / 4, math.sqrt(15 / _PI) / 4
_Y3_3, _Y3_XYZ, _Y3_1 = math.sqrt(35 / (2 * _PI)) / 4, math.sqrt(105 / _PI) / 2, math.sqrt(21 / (2 * _PI)) / 4
_Y3_Z, _Y3_ZXX = math.sqrt(7 / _PI) / 4, math.sqrt(105 / _PI) / 4

# The same for the kernels: a float64 constant would turn their arithmetic to float64.
_f32 = np.float32
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX, _EIGHT = (_f32(x) for x in (0, 0.5, 1, 2, 3, 4, 6, 8))
_K0, _K1, _K2_XY, _K2_Z, _K2_XX = (_f32(x) for x in (Y0, _Y1, _Y2_XY, _Y2_Z, _Y2_XX))
_K3_3, _K3_XYZ, _K3_1, _K3_Z, _K3_ZXX = (_f32(x) for x in (_Y3_3, _Y3_XYZ, _Y3_1, _Y3_Z, _Y3_ZXX))

_FASTMATH = {"contract", "nsz", "arcp"}
_BLOCK = 512  # splats


def coefficients(degree: int) -> int:
    """Number of basis functions up to a degree: 1, 4, 9 or 16."""
    return (degree + 1) ** 2


def dc_from_color(colors: Tensor) -> Tensor:
    """The coefficient of degree 0 that gives a color (display RGB) in all directions."""
    return (colors - COLOR_OFFSET) / Y0


def harmonic_basis(directions: Tensor, degree: int) -> Tensor:  # [M, 3] unit -> [M, (degree + 1)^2]
    """The basis functions in the order of the file."""
    x, y, z = directions.unbind(1)
    values = [torch.full_like(x, Y0)]
    if degree >= 1:
        values += [-_Y1 * y, _Y1 * z, -_Y1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        values += [_Y2_XY * x * y, -_Y2_XY * y * z, _Y2_Z * (2 * zz - xx - yy)]
        values += [-_Y2_XY * x * z, _Y2_XX * (xx - yy)]
    if degree >= 3:
        values += [-_Y3_3 * y * (3 * xx - yy), _Y3_XYZ * x * y * z, -_Y3_1 * y * (4 * zz - xx - yy)]
        values += [_Y3_Z * z * (2 * zz - 3 * xx - 3 * yy), -_Y3_1 * x * (4 * zz - xx - yy)]
        values += [_Y3_ZXX * z * (xx - yy), -_Y3_3 * x * (xx - 3 * yy)]
    return torch.stack(values, 1)


def view_colors(
    means: Tensor,  # [M, 3] world units
    dc: Tensor,  # [M, 3] coefficients of degree 0
    rest: Tensor,  # [M, K, 3] of the degrees above, K at least (degree + 1)^2 - 1; what is beyond is not used
    center: Tensor,  # [3] of the camera, world units
    degree: int,
    visible: Tensor | None = None,  # [M] bool: splats to look at, the others become black; default all
) -> Tensor:  # [M, 3] display RGB, not below 0
    """What a camera sees of each splat; gradients go to means and coefficients."""
    assert 0 <= degree <= MAX_DEGREE and rest.shape[1] >= coefficients(degree) - 1, (degree, rest.shape)
    if means.device.type == "cpu" and means.dtype == torch.float32:
        if visible is None:
            visible = torch.ones(len(means), dtype=torch.bool)
        colors: Tensor = _ViewColors.apply(means, dc, rest, center, degree, visible)
        return colors
    return view_colors_reference(means, dc, rest, center, degree, visible)


def view_colors_reference(
    means: Tensor, dc: Tensor, rest: Tensor, center: Tensor, degree: int, visible: Tensor | None = None
) -> Tensor:
    """`view_colors` in plain torch, on any device and in any precision."""
    directions = torch.nn.functional.normalize(means - center, dim=1)
    basis = harmonic_basis(directions, degree)
    used = rest[:, : basis.shape[1] - 1]
    colors = COLOR_OFFSET + Y0 * dc + (basis[:, 1:, None] * used).sum(1)
    colors = colors.clamp_min(0)
    return colors if visible is None else torch.where(visible[:, None], colors, 0.0)


class _ViewColors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, dc: Tensor, rest: Tensor, center: Tensor, degree: int, visible: Tensor
    ) -> Tensor:
        means, dc, rest, center, visible = (
            t.detach().contiguous() for t in (means, dc, rest, center, visible)
        )
        colors = torch.empty_like(means)
        _colors(
            means.numpy(),
            dc.numpy(),
            rest.numpy(),
            center.numpy(),
            visible.numpy(),
            degree,
            colors.numpy(),
        )
        ctx.save_for_backward(means, dc, rest, center, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, dc, rest, center, colors = ctx.saved_tensors
        d_means, d_dc, d_rest = (torch.empty_like(t) for t in (means, dc, rest))
        _colors_gradient(
            means.numpy(),
            rest.numpy(),
            center.numpy(),
            ctx.degree,
            colors.detach().numpy(),
            gradients[0].contiguous().numpy(),
            d_means.numpy(),
            d_dc.numpy(),
            d_rest.numpy(),
        )
        return d_means, d_dc, d_rest, None, None, None


@njit(inline="always")
def _basis(x, y, z, degree, b):
    """Y_1 ... of one direction, into b [15]."""
    if degree >= 1:
        b[0], b[1], b[2] = -_K1 * y, _K1 * z, -_K1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        b[3], b[4] = _K2_XY * x * y, -_K2_XY * y * z
        b[5] = _K2_Z * (_TWO * zz - xx - yy)
        b[6], b[7] = -_K2_XY * x * z, _K2_XX * (xx - yy)
        if degree >= 3:
            b[8] = -_K3_3 * y * (_THREE * xx - yy)
            b[9] = _K3_XYZ * x * y * z
            b[10] = -_K3_1 * y * (_FOUR * zz - xx - yy)
            b[11] = _K3_Z * z * (_TWO * zz - _THREE * xx - _THREE * yy)
            b[12] = -_K3_1 * x * (_FOUR * zz - xx - yy)
            b[13] = _K3_ZXX * z * (xx - yy)
            b[14] = -_K3_3 * x * (xx - _THREE * yy)


@njit(inline="always")
def _along(x, y, z, degree, g):
    """Gradient by (x, y, z) of sum_k g_k Y_k, the Y taken as polynomials."""
    gx, gy, gz = _ZERO, _ZERO, _ZERO
    if degree >= 1:
        gx, gy, gz = -_K1 * g[2], -_K1 * g[0], _K1 * g[1]
    if degree >= 2:
        xy, ring = _K2_XY * g[3], _TWO * _K2_Z * g[5]
        yz, xz, fan = _K2_XY * g[4], _K2_XY * g[6], _TWO * _K2_XX * g[7]
        gx += xy * y - ring * x - xz * z + fan * x
        gy += xy * x - yz * z - ring * y - fan * y
        gz += _TWO * ring * z - yz * y - xz * x
        if degree >= 3:
            xx, yy, zz = x * x, y * y, z * z
            h3, hxyz, h1 = _K3_3 * g[8], _K3_XYZ * g[9], _K3_1 * g[10]
            hz, k1, hzxx, k3 = _K3_Z * g[11], _K3_1 * g[12], _K3_ZXX * g[13], _K3_3 * g[14]
            gx += -h3 * _SIX * x * y + hxyz * y * z + h1 * _TWO * x * y - hz * _SIX * x * z
            gx += -k1 * (_FOUR * zz - _THREE * xx - yy) + hzxx * _TWO * x * z - k3 * _THREE * (xx - yy)
            gy += -h3 * _THREE * (xx - yy) + hxyz * x * z - h1 * (_FOUR * zz - xx - _THREE * yy)
            gy += -hz * _SIX * y * z + k1 * _TWO * x * y - hzxx * _TWO * y * z + k3 * _SIX * x * y
            gz += hxyz * x * y - h1 * _EIGHT * y * z + hz * (_SIX * zz - _THREE * xx - _THREE * yy)
            gz += -k1 * _EIGHT * x * z + hzxx * (xx - yy)
    return gx, gy, gz


@njit(parallel=True, fastmath=_FASTMATH, error_model="numpy", cache=True)
def _colors(means, dc, rest, center, visible, degree, colors):
    n, used = len(means), (degree + 1) * (degree + 1) - 1
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        b = np.empty(15, np.float32)
        for i in range(block * _BLOCK, min(block * _BLOCK + _BLOCK, n)):
            if not visible[i]:
                colors[i, 0] = colors[i, 1] = colors[i, 2] = _ZERO
                continue
            x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
            inverse = _ONE / max(np.sqrt(x * x + y * y + z * z), _f32(1e-12))
            _basis(x * inverse, y * inverse, z * inverse, degree, b)
            red, green, blue = (_HALF + _K0 * dc[i, 0], _HALF + _K0 * dc[i, 1], _HALF + _K0 * dc[i, 2])
            for k in range(used):
                red += b[k] * rest[i, k, 0]
                green += b[k] * rest[i, k, 1]
                blue += b[k] * rest[i, k, 2]
            colors[i, 0], colors[i, 1], colors[i, 2] = max(red, _ZERO), max(green, _ZERO), max(blue, _ZERO)


@njit(parallel=True, fastmath=_FASTMATH, error_model="numpy", cache=True)
def _colors_gradient(means, rest, center, degree, colors, d_colors, d_means, d_dc, d_rest):
    n, held, used = len(means), rest.shape[1], (degree + 1) * (degree + 1) - 1
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        b, g = np.empty(15, np.float32), np.empty(15, np.float32)
        for i in range(block * _BLOCK, min(block * _BLOCK + _BLOCK, n)):
            # Nothing reaches a channel that was clamped; splats out of view are black in all three.
            red = d_colors[i, 0] if colors[i, 0] > _ZERO else _ZERO
            green = d_colors[i, 1] if colors[i, 1] > _ZERO else _ZERO
            blue = d_colors[i, 2] if colors[i, 2] > _ZERO else _ZERO
            d_dc[i, 0], d_dc[i, 1], d_dc[i, 2] = _K0 * red, _K0 * green, _K0 * blue
            if red == _ZERO and green == _ZERO and blue == _ZERO:
                d_means[i, 0] = d_means[i, 1] = d_means[i, 2] = _ZERO
                for k in range(held):
                    d_rest[i, k, 0] = d_rest[i, k, 1] = d_rest[i, k, 2] = _ZERO
                continue
            x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
            inverse = _ONE / max(np.sqrt(x * x + y * y + z * z), _f32(1e-12))
            x, y, z = x * inverse, y * inverse, z * inverse
            _basis(x, y, z, degree, b)
            for k in range(used):
                d_rest[i, k, 0], d_rest[i, k, 1], d_rest[i, k, 2] = b[k] * red, b[k] * green, b[k] * blue
                g[k] = red * rest[i, k, 0] + green * rest[i, k, 1] + blue * rest[i, k, 2]
            for k in range(used, held):
                d_rest[i, k, 0] = d_rest[i, k, 1] = d_rest[i, k, 2] = _ZERO
            gx, gy, gz = _along(x, y, z, degree, g)
            # The length of mean - centre does not matter: only what is across the direction moves it.
            radial = gx * x + gy * y + gz * z
            d_means[i, 0] = (gx - radial * x) * inverse
            d_means[i, 1] = (gy - radial * y) * inverse
            d_means[i, 2] = (gz - radial * z) * inverse
