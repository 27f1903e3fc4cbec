"""Scalar quantization (CompGS Sec. 3.3).

`y` is a latent in units of its quantization step, `mean` the mean that the entropy model predicts for it, `y_hat` the
value that the decoder will have. Rendering sees rounded values with a straight-through gradient, the likelihood sees
values with uniform noise (Ballé et al. 2017); both as in the authors' release.
"""

import copy
import functools
from collections.abc import Sequence
from dataclasses import dataclass
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
    return int(_exponents(_largest(weight), largest_integer(bits)))


def largest_integer(bits: int) -> int:
    """The largest that so many signed bits hold; its negative is the smallest."""
    return (1 << (bits - 1)) - 1


def in_stored_steps(weight: Tensor, bits: int) -> Tensor:
    """The weight in units of the step in which the file will hold it, not rounded; found without reading a value."""
    return weight * torch.exp2(_exponents(_largest(weight), largest_integer(bits))).to(weight.dtype)


def _largest(weight: Tensor) -> Tensor:
    """[] the largest size of a weight; 0 if there is none."""
    sizes = weight.detach().abs()
    return sizes.max() if sizes.numel() else sizes.sum()


def _exponents(largest: Tensor, limit: Tensor | int) -> Tensor:
    """[...] float64: largest e in 0 to 24 for which weights of `largest` sizes [...] stay within a `limit`, as integers
    after a multiplication by 2^e. On the device of the weights: to read them would wait for a GPU in every step.
    """
    largest = largest.double()
    exponent = torch.floor(torch.log2(limit / largest))
    exponent = torch.where(torch.round(largest * torch.exp2(exponent)) > limit, exponent - 1.0, exponent)
    # Zero, and what is not finite (the loss says so if a training has diverged), count as 0.
    usable = (largest > 0.0) & torch.isfinite(largest)
    return torch.where(usable, exponent.clamp(0.0, 24.0), torch.zeros_like(exponent))


def quantize_weight(weight: Tensor, bits: int) -> Tensor:
    """The weight as the file will hold it (an integer of `bits` bits times a power of two), straight-through."""
    limit = largest_integer(bits)
    step = torch.exp2(-_exponents(_largest(weight), limit)).to(weight.dtype)
    stored = (weight.detach() / step).round().clamp_(-limit, limit) * step
    return weight + (stored - weight).detach()


@dataclass(frozen=True)
class WeightRounding:
    """What rounding adds to several weights, found for all of them at once: a GPU starts two dozen kernels in place of
    a dozen for each weight.
    """

    added: Tensor  # [all numbers of the weights, one weight after the other]

    @classmethod
    @torch.no_grad()
    def of(cls, weights: Sequence[Tensor], bits: Sequence[int]) -> "WeightRounding":
        """Round weights, of which none is empty, to so many `bits` each, as `quantize_weight` does."""
        flat = _joined(weights)
        owner, limits = _owners(tuple(w.numel() for w in weights), tuple(bits), flat.device)
        largest = flat.new_zeros(len(weights)).scatter_reduce_(0, owner, flat.abs(), "amax")
        steps = torch.exp2(-_exponents(largest, limits)).to(flat.dtype)[owner]
        limit = limits.to(flat.dtype)[owner]
        return cls((flat / steps).round().clamp(-limit, limit) * steps - flat)

    def applied(self, weights: Sequence[Tensor]) -> list[Tensor]:
        """The weights as the file will hold them, straight-through."""
        flat = _joined(weights) + self.added
        parts = flat.split([weight.numel() for weight in weights])
        return [part.view(weight.shape) for part, weight in zip(parts, weights, strict=True)]


def quantize_weights(weights: Sequence[Tensor], bits: Sequence[int]) -> list[Tensor]:
    """Each of the weights as `quantize_weight` gives it, in few operations however many they are."""
    if len(weights) == 1:
        return [quantize_weight(weights[0], bits[0])]
    return WeightRounding.of(weights, bits).applied(weights)


def _joined(weights: Sequence[Tensor]) -> Tensor:
    return torch.cat([weight.reshape(-1) for weight in weights])


@functools.lru_cache(maxsize=64)
def _owners(lengths: tuple[int, ...], bits: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Which weight each number of several belongs to, and [weights] float64 the largest integer of each; kept, as a
    copy to a GPU waits for it to finish its work.
    """
    owner = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    limits = torch.tensor([largest_integer(b) for b in bits], dtype=torch.float64)
    return owner.to(device), limits.to(device)
