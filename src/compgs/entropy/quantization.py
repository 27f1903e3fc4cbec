"""Scalar quantization (CompGS Sec. 3.3).

`y` is a latent in units of its quantization step, `mean` the mean that the entropy model predicts for it, `y_hat` the
value that the decoder will have. Rendering sees rounded values with a straight-through gradient, the likelihood sees
values with uniform noise (Ballé et al. 2017); both as in the authors' release.
"""

import math

import torch
from torch import Tensor


def round_straight_through(x: Tensor) -> Tensor:
    """Nearest integer; the gradient passes as if nothing had happened."""
    return x + (x.round() - x).detach()


def quantize(y: Tensor, mean: Tensor) -> Tensor:
    """y_hat = round(y - mean) + mean: what the decoder reconstructs from the symbol round(y - mean).

    The gradient goes to `y` alone: a gradient into the mean would let rendering move reconstruction values that
    only the rate should choose.
    """
    mean = mean.detach()
    return round_straight_through(y - mean) + mean


def uniform_noise(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Noise in [-0.5, 0.5) that stands for rounding inside the likelihood."""
    noise = torch.empty_like(like)
    return noise.uniform_(-0.5, 0.5, generator=generator)


def weight_exponent(weight: Tensor, bits: int) -> int:
    """Largest e in 0..24 for which round(weight * 2^e) fits into `bits` signed bits."""
    largest = float(weight.detach().abs().max()) if weight.numel() else 0.0
    limit = (1 << (bits - 1)) - 1
    if largest <= 0.0:
        return 0
    exponent = math.floor(math.log2(limit / largest))
    while exponent > 0 and round(largest * 2.0**exponent) > limit:
        exponent -= 1
    return max(0, min(24, exponent))


def quantize_weight(weight: Tensor, bits: int) -> Tensor:
    """The weight as the file will hold it (an integer of `bits` bits times a power of two), straight-through."""
    exponent = weight_exponent(weight, bits)
    limit = (1 << (bits - 1)) - 1
    step = 2.0**-exponent
    stored = (weight.detach() / step).round().clamp_(-limit, limit) * step
    return weight + (stored - weight).detach()
