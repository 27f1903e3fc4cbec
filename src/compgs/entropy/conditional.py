"""Latents coded around means and scales that a network predicts from what is decoded already (CompGS Sec. 3.3).

    [mean, scale] = W context + b     symbol = round(y - mean)     y_hat = symbol + mean     bits = -log2 p(symbol)

On the CPU everything between the two matrix products of the forward and of the backward pass is one pass over the
latents: written out in torch, a dozen passes over them cost more than the products.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.entropy.gaussian import BLOCK, FASTMATH, SCALE_LEVELS, element_bits, gaussian_bits
from compgs.entropy.network import FRACTION_BITS, EntropyNetwork, round_fixed
from compgs.entropy.quantization import quantize, round_straight_through
from compgs.numerics.compiled import chunk_of, njit
from compgs.tensors import where
from compgs.tensors.linear import transposed_product

Noise = Callable[[Tensor], Tensor]


def code_latents(
    y: Tensor,  # [N, C] in quantization steps
    context: Tensor,  # [N, inputs] what the decoder has by then
    network: EntropyNetwork,
    *,
    rate: bool,
    noise: Noise | None = None,
    network_bits: int | None = None,
    mask: Tensor | None = None,  # [N, K] bool: slots of C / K channels that are coded; default all
) -> tuple[Tensor, Tensor]:
    """y_hat [N, C], and the bits [N] of each row; [0] if not `rate`.

    With `noise` the likelihood sees y - mean with uniform noise (training), without it the symbol itself.
    `network_bits`: the network's weights as the file will hold them.
    """
    inputs, weight, bias = network.inputs_of_last(context, network_bits)
    fixed = network_bits is not None
    if where.in_kernels(y, inputs):
        uniform = noise(y) if rate and noise is not None else None
        y_hat, bits = _Coded.apply(y, inputs, weight, bias, uniform, rate, fixed, mask)
        return y_hat, bits
    out = torch.addmm(bias, inputs, weight.t())
    mean, scale = (round_fixed(out) if fixed else out).chunk(2, 1)
    y_hat = quantize(y, mean)
    if not rate:
        return y_hat, y.new_empty(0)
    x = y - mean
    x = x + noise(x) if noise is not None else round_straight_through(x)
    if mask is None:
        return y_hat, gaussian_bits(x, scale)
    slots = mask.numel()
    bits = gaussian_bits(x.reshape(slots, -1), scale.reshape(slots, -1)).view_as(mask)
    return y_hat, (bits * mask).sum(1)


class _Coded(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        y: Tensor,
        context: Tensor,
        weight: Tensor,  # [2 C, inputs]
        bias: Tensor,  # [2 C]
        noise: Tensor | None,
        rate: bool,
        fixed: bool,
        mask: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        y = y.contiguous()
        n, c = y.shape
        out = torch.addmm(bias, context, weight.t())
        y_hat = torch.empty_like(y)
        counted = n if rate else 0
        bits = y.new_empty(counted)
        by_x, by_s = y.new_empty(counted, c), y.new_empty(counted, c)
        slots = np.empty((0, 1), np.bool_) if mask is None else mask.contiguous().numpy()
        _code(
            _array(y),
            _array(out),
            np.empty((0, c), np.float32) if noise is None else _array(noise.contiguous()),
            slots,
            fixed,
            y_hat.numpy(),
            bits.numpy(),
            by_x.numpy(),
            by_s.numpy(),
        )
        if rate:
            ctx.save_for_backward(context, weight, out, by_x, by_s)
        ctx.rate = rate
        ctx.set_materialize_grads(False)
        return y_hat, bits

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        by_y_hat, by_bits = grads
        if not ctx.rate or by_bits is None:
            return by_y_hat, None, None, None, None, None, None, None
        context, weight, out, by_x, by_s = ctx.saved_tensors
        d_y, d_out = torch.empty_like(by_x), torch.empty_like(out)
        _code_gradient(
            _array(out),
            _array(by_x),
            _array(by_s),
            _array(by_bits.contiguous()),
            np.empty((0, by_x.shape[1]), np.float32) if by_y_hat is None else _array(by_y_hat.contiguous()),
            d_y.numpy(),
            d_out.numpy(),
        )
        d_context = d_out @ weight if ctx.needs_input_grad[1] else None
        d_weight = transposed_product(d_out, context) if ctx.needs_input_grad[2] else None
        d_bias = d_out.sum(0) if ctx.needs_input_grad[3] else None
        return d_y, d_context, d_weight, d_bias, None, None, None, None


def _array(x: Tensor) -> np.ndarray:
    return x.detach().numpy()


_ZERO = np.float32(0)
_ONE_FIXED, _FIXED_STEP = np.float32(1 << FRACTION_BITS), np.float32(2.0**-FRACTION_BITS)
_HALF = np.float32(0.5)
_TOP = np.float32(SCALE_LEVELS - 1)


@njit(fastmath=FASTMATH)
def _quantize_row(y, out, noise, fixed, y_hat, x, s):
    """One row: y_hat, and what the likelihood sees: x [C] and scale indices s [C]."""
    c = len(y)
    for i in range(c):
        mean, scale = out[i], out[c + i]
        if fixed:
            mean = np.floor(mean * _ONE_FIXED + _HALF) * _FIXED_STEP  # as `round_fixed`
            scale = np.floor(scale * _ONE_FIXED + _HALF) * _FIXED_STEP
        distance = y[i] - mean
        symbol = np.rint(distance)
        y_hat[i] = symbol + mean
        x[i] = distance + noise[i] if len(noise) > 0 else symbol
        s[i] = scale


@njit(parallel=True)
def _code(y, out, noise, mask, fixed, y_hat, bits, by_x, by_s, part):
    """noise [0, C]: none; mask [0, 1]: all slots; bits [0]: not wanted."""
    n, c = y.shape
    rows = max(1, BLOCK // max(c, 1))
    flat_x, flat_s = by_x.reshape(-1), by_s.reshape(-1)
    none = np.empty(0, np.float32)
    for block in chunk_of((n + rows - 1) // rows, part):
        first, last = block * rows, min(n, (block + 1) * rows)
        scratch = np.empty((3, rows * c), np.float32)
        for i in range(first, last):
            p, q = (i - first) * c, (i - first + 1) * c
            row_noise = noise[i] if len(noise) > 0 else none
            _quantize_row(y[i], out[i], row_noise, fixed, y_hat[i], scratch[0, p:q], scratch[1, p:q])
        if len(bits) == 0:
            continue
        size = (last - first) * c
        p, q = first * c, last * c
        element_bits(scratch[0, :size], scratch[1, :size], scratch[2], flat_x[p:q], flat_s[p:q])
        for i in range(first, last):
            start = (i - first) * c
            if len(mask) > 0:
                width = c // mask.shape[1]
                for k in range(mask.shape[1]):
                    if not mask[i, k]:
                        scratch[2, start + k * width : start + (k + 1) * width] = _ZERO
                        by_x[i, k * width : (k + 1) * width] = _ZERO
                        by_s[i, k * width : (k + 1) * width] = _ZERO
            total = _ZERO
            for j in range(start, start + c):
                total += scratch[2, j]
            bits[i] = total


@njit(fastmath=FASTMATH)
def _gradient_row(out, by_x, by_s, g, by_y_hat, d_y, d_out):
    """A gradient that leads a scale away from the tables is dropped."""
    c = len(by_x)
    for i in range(c):
        s = out[c + i]
        a = g * by_x[i]
        b = g * by_s[i]
        b = _ZERO if (s < _ZERO and b > _ZERO) else b
        b = _ZERO if (s > _TOP and b < _ZERO) else b
        d_y[i] = a + by_y_hat[i] if len(by_y_hat) > 0 else a
        d_out[i] = -a
        d_out[c + i] = b


@njit(parallel=True)
def _code_gradient(out, by_x, by_s, g, by_y_hat, d_y, d_out, part):
    none = np.empty(0, np.float32)
    for i in chunk_of(len(g), part):
        row = by_y_hat[i] if len(by_y_hat) > 0 else none
        _gradient_row(out[i], by_x[i], by_s[i], g[i], row, d_y[i], d_out[i])
