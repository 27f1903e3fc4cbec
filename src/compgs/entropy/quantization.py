"""Scalar quantization (CompGS Sec. 3.3).

`y` is a latent in units of its quantization step, `mean` the mean that the entropy model predicts for it, `y_hat` the
value that the decoder will have. Rendering sees rounded values with a straight-through gradient, the likelihood sees
values with uniform noise (Ballé et al. 2017); both as in the authors' release.
"""

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor


class _Round(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.round()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0]


class _RoundAround(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, y: Tensor, mean: Tensor) -> Tensor:
        return (y - mean).round_().add_(mean)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0], None


def round_straight_through(x: Tensor) -> Tensor:
    """Nearest integer; the gradient passes as if nothing had happened."""
    return _Round.apply(x)


def quantize(y: Tensor, mean: Tensor) -> Tensor:
    """y_hat = round(y - mean) + mean: what the decoder reconstructs from the symbol round(y - mean).

    The gradient goes to `y` alone: a gradient into the mean would let rendering move reconstruction values that
    only the rate should choose.
    """
    return _RoundAround.apply(y, mean)


class UniformNoise:
    """Noise in [-0.5, 0.5) that stands for rounding inside the likelihood.

    Cut at random places from a pool that is drawn once: half a million new numbers in every step would take as long
    as the entropy networks. What the pool cannot give without repeating itself is drawn anew, from a seed of `places`,
    so that a run goes on with the same numbers wherever it was stopped.
    """

    POOL = 1 << 22

    def __init__(self, seed: int, places: np.random.Generator, device: torch.device | str = "cpu") -> None:
        generator = torch.Generator(device).manual_seed(seed)
        self.pool = torch.rand(self.POOL, generator=generator, device=device) - 0.5
        self.places = places

    def of_places(self, places: np.random.Generator) -> "UniformNoise":
        """Noise of the same pool, from other places."""
        other = copy.copy(self)
        other.places = places
        return other

    def __call__(self, like: Tensor) -> Tensor:
        """Noise of the shape of `like`, to be read only."""
        count = like.numel()
        if count > self.POOL // 2:
            generator = torch.Generator(like.device).manual_seed(int(self.places.integers(1 << 62)))
            return torch.rand(like.shape, generator=generator, device=like.device) - 0.5
        place = int(self.places.integers(self.POOL - count + 1))
        return self.pool[place : place + count].view(like.shape)


def weight_exponent(weight: Tensor, bits: int) -> int:
    """Largest e in 0..24 for which round(weight * 2^e) fits into `bits` signed bits."""
    return int(_weight_exponent(weight, bits))


def _weight_exponent(weight: Tensor, bits: int) -> Tensor:
    """[] float64; stays on the weight's device, as reading it would wait for a GPU in every step."""
    if not weight.numel():
        return torch.zeros((), dtype=torch.float64, device=weight.device)
    largest = weight.detach().abs().max().double()
    limit = (1 << (bits - 1)) - 1
    exponent = torch.floor(torch.log2(limit / largest))
    exponent = torch.where(torch.round(largest * torch.exp2(exponent)) > limit, exponent - 1.0, exponent)
    # Zero, and what is not finite (the loss says so if a training has diverged), count as 0.
    usable = (largest > 0.0) & torch.isfinite(largest)
    return torch.where(usable, exponent.clamp(0.0, 24.0), torch.zeros_like(exponent))


def quantize_weight(weight: Tensor, bits: int) -> Tensor:
    """The weight as the file will hold it (an integer of `bits` bits times a power of two), straight-through."""
    step = torch.exp2(-_weight_exponent(weight, bits)).to(weight.dtype)
    limit = (1 << (bits - 1)) - 1
    stored = (weight.detach() / step).round().clamp_(-limit, limit) * step
    return weight + (stored - weight).detach()
