"""Structural similarity (Wang et al. 2004) as 3DGS computes it, fused with L1 and the gradient, on the CPU.

`x` is the image, `y` the target, both [H, W, 3] in 0 to 1; every channel by itself. m, n are their local
means under an 11 x 11 Gaussian window (sigma 1.5, zeros outside the image), v, w the local variances, c the
local covariance:

    SSIM = (2 m n + C1) (2 c + C2) / ((m^2 + n^2 + C1) (v + w + C2)),    averaged over pixels and channels

With a mask, pixels that do not count are treated as those outside of the image: zero in both for the windows that reach
them, and not averaged over.
"""

import math

import numpy as np

from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.vector_sums import add_in_any_order

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def window() -> np.ndarray:
    """[11] float64, sums to one; the two-dimensional window is its outer product with itself."""
    offset = np.arange(WINDOW_SIZE) - WINDOW_SIZE // 2
    weight = np.exp(-0.5 * (offset / WINDOW_SIGMA) ** 2)
    return weight / weight.sum()


# fused: CPU, float32 ----------------------------------------------------------------------------------------
#
# Rows of pixels are treated as they lie in memory, R G B R G B ...: neighbours of the window are 3 floats
# apart. Tiles of columns keep the eleven rows of the window in the first-level cache. Scratch rows lie at
# constant distances in one array: otherwise LLVM cannot tell that they do not overlap, and does not
# vectorize.

_f = np.float32
_u = np.uint64
_FASTMATH = {"contract", "nsz", "arcp"}
_TILE = 480  # floats in a row of a tile
_HALO = 3 * (WINDOW_SIZE // 2)  # floats on each side
_STRIDE = _TILE + 2 * _HALO + 2
_S1, _S2, _S3, _S4, _S5 = (_u(k * _STRIDE) for k in range(1, 6))
_S6, _S7 = _u(6 * _STRIDE), _u(7 * _STRIDE)
_SCRATCH = 8 * _STRIDE
_RADIUS = WINDOW_SIZE // 2

_TAPS = window().astype(np.float32)
_G0, _G1, _G2, _G3, _G4, _G5 = (_TAPS[k] for k in range(6))
_C1, _C2 = _f(C1), _f(C2)
_ONE, _TWO, _ZERO = _f(1.0), _f(2.0), _f(0.0)


@njit(inline="always")
def _across(S, i):
    """Horizontal window around scratch element i + _HALO."""
    side = _G0 * (S[i] + S[i + _u(30)]) + _G1 * (S[i + _u(3)] + S[i + _u(27)])
    side += _G2 * (S[i + _u(6)] + S[i + _u(24)]) + _G3 * (S[i + _u(9)] + S[i + _u(21)])
    return side + _G4 * (S[i + _u(12)] + S[i + _u(18)]) + _G5 * S[i + _u(15)]


@njit
def _find_rows(r, H, rows, weights):
    """Fills in the rows [11] uint64 of the window around row `r` of `H`, and their weights [11] float32; beyond the
    image some row of no weight.
    """
    for k in range(WINDOW_SIZE):
        row = r + k - _RADIUS
        inside = 0 <= row < H
        rows[k] = row if inside else r
        weights[k] = _TAPS[k] if inside else _ZERO


@njit(fastmath=_FASTMATH, no_alias=True)
def _products(S, at, x, y, scale, rows, weights, left, right):
    """Weighted sums over rows [11] of x, y, x x, y y and x y, for columns from `left` to `right`: to scratch rows 0 to
    4, from element `at`.
    """
    at, left = _u(at), _u(left)
    for i in range(_u(right) - left):
        c = left + i
        m = n = xx = yy = xy = _ZERO
        for k in range(WINDOW_SIZE):
            a, b = x[rows[k], c], _f(y[rows[k], c]) * scale
            wa, wb = weights[k] * a, weights[k] * b
            m, n, xx, yy, xy = m + wa, n + wb, xx + wa * a, yy + wb * b, xy + wa * b
        o = at + i
        S[o], S[o + _S1], S[o + _S2], S[o + _S3], S[o + _S4] = m, n, xx, yy, xy


@njit(fastmath=_FASTMATH, error_model="numpy")
def _similarity(S, n, counts=None):
    """Sum of SSIM over n elements of a row, times `counts` [n] float32 (None: one); its gradient by m, xx and xy goes
    to scratch rows 5 to 7."""
    total = _ZERO
    for i in range(_u(n)):
        m, k = _across(S, i), _across(S, i + _S1)
        xx, yy, xy = _across(S, i + _S2), _across(S, i + _S3), _across(S, i + _S4)
        a1, a2 = _TWO * m * k + _C1, _TWO * (xy - m * k) + _C2
        b1, b2 = m * m + k * k + _C1, xx - m * m + yy - k * k + _C2
        inverse = _ONE / (b1 * b2)
        value = a1 * a2 * inverse
        d_m = _TWO * inverse * (k * (a2 - a1) + m * value * (b1 - b2))
        d_xx = -value * b1 * inverse
        d_xy = _TWO * a1 * inverse
        if counts is not None:
            value, d_m, d_xx, d_xy = counts[i] * value, counts[i] * d_m, counts[i] * d_xx, counts[i] * d_xy
        total = add_in_any_order(total, value)
        S[i + _S5] = d_m
        S[i + _S6] = d_xx
        S[i + _S7] = d_xy
    return total


@njit(fastmath=_FASTMATH, no_alias=True)
def _summed_maps(S, at, maps, rows, weights, left, right):
    """Weighted sums over rows [11] of the three maps [H, 3, C]: to scratch rows 0 to 2, as `_products`."""
    at, left = _u(at), _u(left)
    for i in range(_u(right) - left):
        c = left + i
        m = xx = xy = _ZERO
        for k in range(WINDOW_SIZE):
            row, weight = rows[k], weights[k]
            m += weight * maps[row, 0, c]
            xx += weight * maps[row, 1, c]
            xy += weight * maps[row, 2, c]
        o = at + i
        S[o], S[o + _S1], S[o + _S2] = m, xx, xy


@njit(fastmath=_FASTMATH)
def _combine(S, x, y, scale, ssim_factor, l1_factor, d_x):
    """Gradient of one row of the loss."""
    for i in range(_u(x.size)):
        a = x[i]
        b = _f(y[i]) * scale
        d = _across(S, i) + _TWO * a * _across(S, i + _S1) + b * _across(S, i + _S2)
        sign = _ONE if a > b else _ZERO
        sign = -_ONE if a < b else sign
        d_x[i] = ssim_factor * d + l1_factor * sign


@njit(fastmath=_FASTMATH)
def _absolute_difference(x, y, scale):
    total = _ZERO
    for i in range(_u(x.size)):
        total = add_in_any_order(total, abs(x[i] - _f(y[i]) * scale))
    return total


@njit(parallel=True)
def _compare(x, y, scale, maps, sums, counts, part):
    """x, y [H, 3 W] -> sums [H, 2] of |x - y| and SSIM by row, maps [H, 3, 3 W] of the gradient of SSIM.

    counts [H, 3 W] float32: factors on SSIM at each element; None: one.
    """
    H, W = x.shape
    S = np.empty(_SCRATCH, np.float32)
    rows, weights = np.empty(WINDOW_SIZE, np.uint64), np.empty(WINDOW_SIZE, np.float32)
    for r in chunk_of(H, part):
        _find_rows(r, H, rows, weights)
        similarity = 0.0
        for first in range(0, W, _TILE):
            last = min(W, first + _TILE)
            left, right = max(0, first - _HALO), min(W, last + _HALO)
            S[:] = _ZERO
            _products(S, left - (first - _HALO), x, y, scale, rows, weights, left, right)
            if counts is None:
                similarity += _similarity(S, last - first)
            else:
                similarity += _similarity(S, last - first, counts[r, first:last])
            for q in range(3):
                maps[r, q, first:last] = S[(5 + q) * _STRIDE : (5 + q) * _STRIDE + last - first]
        sums[r, 0] = _absolute_difference(x[r], y[r], scale)
        sums[r, 1] = similarity


@njit(parallel=True)
def _compare_gradient(x, y, scale, maps, ssim_factor, l1_factor, d_x, part):
    """d_x [H, 3 W] = ssim_factor * dSSIM/dx + l1_factor * sign(x - y)."""
    H, W = x.shape
    S = np.empty(_SCRATCH, np.float32)
    rows, weights = np.empty(WINDOW_SIZE, np.uint64), np.empty(WINDOW_SIZE, np.float32)
    for r in chunk_of(H, part):
        _find_rows(r, H, rows, weights)
        for first in range(0, W, _TILE):
            last = min(W, first + _TILE)
            left, right = max(0, first - _HALO), min(W, last + _HALO)
            S[:] = _ZERO
            _summed_maps(S, left - (first - _HALO), maps, rows, weights, left, right)
            y_row, d_row = y[r, first:last], d_x[r, first:last]
            _combine(S, x[r, first:last], y_row, scale, ssim_factor, l1_factor, d_row)


def l1_and_ssim(
    x: np.ndarray,  # [H, W, 3] float32, C order
    y: np.ndarray,  # [H, W, 3] uint8 or float32, C order
    ssim_weight: float = 0.2,
    want_gradient: bool = False,
    counted: np.ndarray | None = None,  # [H, W] bool: pixels to average over; None: all
) -> tuple[float, float, np.ndarray | None]:
    """Mean |x - y|, mean SSIM, and the gradient [H, W, 3] of (1 - w) L1 + w (1 - SSIM) by x.

    Where no pixel counts, nothing differs: 0, 1 and a gradient of zeros.
    """
    H = x.shape[0]
    scale = _f(1.0 / 255.0 if y.dtype == np.uint8 else 1.0)
    elements, counts = x.size, None
    if counted is not None:
        elements = max(3 * int(np.count_nonzero(counted)), 1)
        x, y = x * counted[:, :, None], y * counted[:, :, None]
        counts = np.repeat(counted.astype(np.float32), 3, axis=1)
    rows_x, rows_y = x.reshape(H, -1), y.reshape(H, -1)
    maps = np.empty((H, 3, rows_x.shape[1]), np.float32)
    sums = np.empty((H, 2))
    _compare(rows_x, rows_y, scale, maps, sums, counts)
    l1, similarity = math.fsum(sums[:, 0]) / elements, math.fsum(sums[:, 1]) / elements
    if counted is not None and not counted.any():
        similarity = 1.0
    if not want_gradient:
        return l1, similarity, None
    gradient = np.empty_like(x)
    l1_factor, ssim_factor = _f((1.0 - ssim_weight) / elements), _f(-ssim_weight / elements)
    _compare_gradient(rows_x, rows_y, scale, maps, ssim_factor, l1_factor, gradient.reshape(H, -1))
    if counted is not None:
        gradient *= counted[:, :, None]
    return l1, similarity, gradient
