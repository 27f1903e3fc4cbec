"""Colors of splats on the CPU, on numpy arrays; `spherical_harmonics.py`, the readable twin, says what is meant."""

import math

import numpy as np

from compgs.numerics.compiled import chunk_of, njit

_PI = math.pi
# Norms of the basis functions: Y<degree>, and the monomials that they belong to.
Y0 = math.sqrt(1 / _PI) / 2
Y1 = math.sqrt(3 / _PI) / 2
Y2_XY, Y2_Z, Y2_XX = math.sqrt(15 / _PI) / 2, math.sqrt(5 / _PI) / 4, math.sqrt(15 / _PI) / 4
Y3_3, Y3_XYZ, Y3_1 = math.sqrt(35 / (2 * _PI)) / 4, math.sqrt(105 / _PI) / 2, math.sqrt(21 / (2 * _PI)) / 4
Y3_Z, Y3_ZXX = math.sqrt(7 / _PI) / 4, math.sqrt(105 / _PI) / 4

# The same for the kernels: a float64 constant would turn their arithmetic to float64.
_f32 = np.float32
_ZERO, _HALF, _ONE, _TWO, _THREE, _FOUR, _SIX, _EIGHT = (_f32(x) for x in (0, 0.5, 1, 2, 3, 4, 6, 8))
_K0, _K1, _K2_XY, _K2_Z, _K2_XX = (_f32(x) for x in (Y0, Y1, Y2_XY, Y2_Z, Y2_XX))
_K3_3, _K3_XYZ, _K3_1, _K3_Z, _K3_ZXX = (_f32(x) for x in (Y3_3, Y3_XYZ, Y3_1, Y3_Z, Y3_ZXX))

_FASTMATH = {"contract", "nsz", "arcp"}
_BLOCK = 512  # splats


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
def _position_gradient(x, y, z, degree, g):
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


@njit(parallel=True, fastmath=_FASTMATH, error_model="numpy")
def view_colors(
    means,  # [M, 3] world units
    dc,  # [M, 3] coefficients of degree 0
    rest,  # [M, K, 3] of the degrees above
    center,  # [3] of the camera, world units
    visible,  # [M] bool: the others become black
    degree,  # up to which coefficients are used
    colors,  # [M, 3] display RGB, written
    part,
):
    n, used = len(means), (degree + 1) * (degree + 1) - 1
    for block in chunk_of((n + _BLOCK - 1) // _BLOCK, part):
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


@njit(parallel=True, fastmath=_FASTMATH, error_model="numpy")
def view_colors_gradient(
    means,
    rest,
    center,
    degree,
    colors,  # [M, 3] from `view_colors`
    d_colors,  # [M, 3] gradient by them
    d_means,  # [M, 3], and so on, written
    d_dc,
    d_rest,
    part,
):
    n, held, used = len(means), rest.shape[1], (degree + 1) * (degree + 1) - 1
    for block in chunk_of((n + _BLOCK - 1) // _BLOCK, part):
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
            gx, gy, gz = _position_gradient(x, y, z, degree, g)
            # The length of mean - centre does not matter: only what is across the direction moves it.
            radial = gx * x + gy * y + gz * z
            d_means[i, 0] = (gx - radial * x) * inverse
            d_means[i, 1] = (gy - radial * y) * inverse
            d_means[i, 2] = (gz - radial * z) * inverse
