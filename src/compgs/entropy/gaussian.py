"""Bits of Gaussian-distributed symbols (CompGS Sec. 3.3; Ballé et al. 2018).

A symbol with value `x` relative to its mean, in quantization steps, has the probability

    p = Phi(u) - Phi(l),    u = (|x| + 1/2) / sigma,    l = (|x| - 1/2) / sigma

Scales travel as a *scale index* s, the number of the codec's integer table: sigma = 2^(s/12 - 5) steps,
0 <= s <= 127. The networks predict s itself, so that the decoder needs neither exp nor softplus.

There is no floor under the likelihood: far from the mean it is evaluated as exp(-l^2 / 2) D, whose logarithm
and gradient are good at any distance. With the scaled tail E(t) = exp(t^2 / 2) (1 - Phi(t)),

    l >= 0:  log p = -l^2 / 2 + log D    D = E(l) - r E(u)                          r = exp(-|x| / sigma^2)
    l <  0:  log p = log D               D = 1 - exp(-l^2 / 2) E(-l) - exp(-u^2 / 2) E(u)

On the CPU one vectorized pass computes the bits and both derivatives, which share nearly everything; the
backward pass only scales them.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.numerics.compiled import chunk_of, njit
from compgs.tensors import where

SCALE_LEVELS = 128  # tables of the codec
SCALES_PER_OCTAVE = 12
SCALE_MIN_LOG2 = -5  # sigma of table 0 is 1/32 step

_LOG2_E = math.log2(math.e)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)  # of the standard normal at 0
_TOP = float(SCALE_LEVELS - 1)


def scale_from_index(index: Tensor) -> Tensor:
    """sigma in quantization steps; not clamped."""
    return torch.exp2(index / SCALES_PER_OCTAVE + SCALE_MIN_LOG2)


def index_from_scale(sigma: Tensor) -> Tensor:
    """Inverse of `scale_from_index`."""
    return (torch.log2(sigma) - SCALE_MIN_LOG2) * SCALES_PER_OCTAVE


def gaussian_bits(
    x: Tensor,  # [N, C] symbol, or value with noise, minus its mean; quantization steps
    scale_index: Tensor,  # [N, C], clamped to the tables; outside, only a gradient that leads back passes
) -> Tensor:  # [N] bits of each row
    """-log2 of the Gaussian's mass on the unit interval around x, summed over channels."""
    if where.in_kernels(x, scale_index):
        return _FusedBits.apply(x, scale_index)
    return _torch_bits(x, _InwardClamp.apply(scale_index)).sum(1)


# plain torch: any device and type ---------------------------------------------------------------------------


class _InwardClamp(torch.autograd.Function):
    """Clamp to [0, SCALE_LEVELS - 1]; outside, a gradient passes if descending it leads back inside."""

    @staticmethod
    def forward(ctx: Any, s: Tensor) -> Tensor:
        ctx.save_for_backward(s)
        return s.clamp(0.0, _TOP)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (s,), g = ctx.saved_tensors, grads[0]
        outward = ((s < 0) & (g > 0)) | ((s > _TOP) & (g < 0))
        return g.masked_fill(outward, 0.0)


def _scaled_tail(t: Tensor) -> Tensor:
    return 0.5 * torch.special.erfcx(t * math.sqrt(0.5))


def _torch_bits(x: Tensor, s: Tensor) -> Tensor:
    a, sigma = x.abs(), scale_from_index(s)
    lower, upper = (a - 0.5) / sigma, (a + 0.5) / sigma
    outside = lower >= 0
    # Each branch only sees arguments of its own side: the other's gradient may not be finite.
    far_l, far_u = lower.clamp_min(0.0), torch.where(outside, upper, 1.0)
    decay = torch.exp(torch.where(outside, -a / sigma**2, -1.0))
    far = -0.5 * far_l**2 + torch.log(_scaled_tail(far_l) - decay * _scaled_tail(far_u))
    near_l, near_u = lower.clamp_max(0.0), torch.where(outside, 1.0, upper)
    near = torch.log1p(-0.5 * (torch.erfc(-near_l * math.sqrt(0.5)) + torch.erfc(near_u * math.sqrt(0.5))))
    return -_LOG2_E * torch.where(outside, far, near)


# fused: CPU, float32 ----------------------------------------------------------------------------------------

_f = np.float32
_i = np.int32
FASTMATH = {"contract", "nsz", "arcp"}
BLOCK = 2048  # elements in a pass: scratch memory stays in the first-level cache

# Constants of the kernels in single precision: one double among them would widen every vector.
_HALF, _ONE, _ZERO = _f(0.5), _f(1.0), _f(0.0)
_HALF_LOG2_E, _LOG2_E_F = _f(0.5 * _LOG2_E), _f(_LOG2_E)
_OCTAVES = _f(1.0 / SCALES_PER_OCTAVE)
_GRADIENT = _f(_DENSITY * _LOG2_E)
_GRADIENT_S = _f(_DENSITY / SCALES_PER_OCTAVE)
_TOP_F, _MIN_LOG2 = _f(_TOP), _f(SCALE_MIN_LOG2)
_SQRT2 = _f(math.sqrt(2.0))


# Minimax polynomials of our own, good to single precision; library calls would not be vectorized.
@njit(inline="always")
def _exp2(t):
    """2^t for -100 <= t <= 126 (1e-7 relative); smaller t count as -100, as denormal numbers are slow."""
    t = _f(-100.0) if t < _f(-100.0) else t
    k = np.floor(t + _HALF)
    f = t - k
    p = _f(1.53458074e-4)
    p = p * f + _f(1.339993118e-3)
    p = p * f + _f(9.618488974e-3)
    p = p * f + _f(5.550328777e-2)
    p = p * f + _f(0.2402264689)
    p = p * f + _f(0.6931472057)
    p = p * f + _ONE
    return p * _i(_i(_i(k) + _i(127)) << _i(23)).view(np.float32)


@njit(inline="always")
def _log2(x):
    """log2 of a positive normal number (3e-8 absolute near 1)."""
    bits = _f(x).view(np.int32)
    # Mantissa in [sqrt(1/2), sqrt(2)).
    k = _i(_i(bits - _i(0x3F3504F3)) >> _i(23))
    m = _i(bits - _i(k << _i(23))).view(np.float32) - _ONE
    q = _f(-7.860141435e-2)
    q = q * m + _f(0.1288137959)
    q = q * m + _f(-0.13128417)
    q = q * m + _f(0.1418121811)
    q = q * m + _f(-0.1662459525)
    q = q * m + _f(0.2000228579)
    q = q * m + _f(-0.2500080903)
    q = q * m + _f(0.3333331673)
    # x - x: the bits of not a number look like those of a number.
    return _f(k) + _LOG2_E_F * (m + m * m * (m * q - _HALF)) + (x - x)


@njit(inline="always")
def _tail(t):
    """E(t) = exp(t^2 / 2) (1 - Phi(t)) for t >= 0 (1e-7 relative): a polynomial in y = 1 / (1 + t / 4)."""
    y = _ONE / (_ONE + _f(0.25) * t)
    p = _f(1.978223617e-2)
    p = p * y + _f(-8.087820501e-2)
    p = p * y + _f(9.559853124e-2)
    p = p * y + _f(-3.171876422e-2)
    p = p * y + _f(6.369971878e-2)
    p = p * y + _f(5.897497968e-2)
    p = p * y + _f(8.160313471e-2)
    p = p * y + _f(9.346635341e-2)
    p = p * y + _f(9.973643166e-2)
    p = p * y + _f(9.973556672e-2)
    return p * y


@njit(inline="always")
def _interval(x, s):
    """(1/sigma, l, u, exp of l's part, exp of u's part, D) as in the module's docstring."""
    # In this order, not a number stays one.
    s = _ZERO if s < _ZERO else s
    s = _TOP_F if s > _TOP_F else s
    inverse = _exp2(-_MIN_LOG2 - s * _OCTAVES)
    a = abs(x)
    l = (a - _HALF) * inverse
    u = (a + _HALF) * inverse
    outside = l >= _ZERO
    e_l = _exp2(_ZERO if outside else -_HALF_LOG2_E * l * l)
    e_u = _exp2(-_LOG2_E_F * a * inverse * inverse if outside else -_HALF_LOG2_E * u * u)
    t_l = _tail(abs(l))
    d = (t_l if outside else _ONE - e_l * t_l) - e_u * _tail(u)
    return inverse, l, u, e_l, e_u, d


@njit(fastmath=FASTMATH, error_model="numpy")
def element_bits(x, s, bits, d_x, d_s):
    """Bits and their derivatives; all flat. Kept apart from the parallel loop so that LLVM vectorizes it."""
    for i in range(np.uint64(x.size)):
        inverse, l, u, e_l, e_u, d = _interval(x[i], s[i])
        weight = _ONE / d
        dx = _GRADIENT * weight * inverse * (e_l - e_u)
        d_x[i] = dx if x[i] > _ZERO else -dx
        d_s[i] = _GRADIENT_S * weight * (e_u * u - e_l * l)
        l = _ZERO if l < _ZERO else l
        bits[i] = _HALF_LOG2_E * l * l - _log2(d)


@njit(fastmath=FASTMATH)
def _element_gradient(s, g, by_x, by_s, d_x, d_s):
    """Chain rule; all flat. A gradient that leads s away from the tables is dropped."""
    for i in range(np.uint64(s.size)):
        d_x[i] = g[i] * by_x[i]
        d = g[i] * by_s[i]
        d = _ZERO if (s[i] < _ZERO and d > _ZERO) else d
        d_s[i] = _ZERO if (s[i] > _TOP_F and d < _ZERO) else d


@njit(parallel=True, fastmath=FASTMATH)
def _bits(x, s, channels, bits, by_x, by_s, part):
    """x, s flat [N * C] -> bits [N] and derivatives by_x, by_s, flat as x, or empty if not wanted."""
    N = len(bits)
    rows = max(1, BLOCK // max(channels, 1))
    for block in chunk_of((N + rows - 1) // rows, part):
        scratch = np.empty((3, rows * channels), np.float32)
        first, last = block * rows, min(N, (block + 1) * rows)
        p, q = first * channels, last * channels
        if by_x.size > 0:
            element_bits(x[p:q], s[p:q], scratch[0], by_x[p:q], by_s[p:q])
        else:
            element_bits(x[p:q], s[p:q], scratch[0], scratch[1], scratch[2])
        for r in range(last - first):
            total = _ZERO
            for c in range(channels):
                total += scratch[0, r * channels + c]
            bits[first + r] = total


@njit(parallel=True, fastmath=FASTMATH)
def _bits_gradient(s, channels, g, by_x, by_s, d_x, d_s, part):
    """g [N], the gradient of the bits -> gradients d_x, d_s, flat [N * C] as s."""
    N = len(g)
    rows = max(1, BLOCK // max(channels, 1))
    for block in chunk_of((N + rows - 1) // rows, part):
        scratch = np.empty(rows * channels, np.float32)
        first, last = block * rows, min(N, (block + 1) * rows)
        for r in range(last - first):
            for c in range(channels):
                scratch[r * channels + c] = g[first + r]
        p, q = first * channels, last * channels
        _element_gradient(s[p:q], scratch, by_x[p:q], by_s[p:q], d_x[p:q], d_s[p:q])


def _flat(x: Tensor) -> np.ndarray:
    return x.detach().view(-1).numpy()


class _FusedBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, s: Tensor) -> Tensor:
        x, s = x.contiguous(), s.contiguous()
        bits = x.new_empty(len(x))
        wanted = len(x) if any(ctx.needs_input_grad) else 0
        by_x, by_s = x.new_empty(wanted, x.shape[1]), s.new_empty(wanted, s.shape[1])
        _bits(_flat(x), _flat(s), x.shape[1], bits.numpy(), _flat(by_x), _flat(by_s))
        ctx.save_for_backward(s, by_x, by_s)
        return bits

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        s, by_x, by_s = ctx.saved_tensors
        d_x, d_s = torch.empty_like(by_x), torch.empty_like(by_s)
        g = grads[0].contiguous().numpy()
        _bits_gradient(_flat(s), s.shape[1], g, _flat(by_x), _flat(by_s), _flat(d_x), _flat(d_s))
        return d_x, d_s
