"""Gradients of which a sample is led on, against all of them."""

import numpy as np
import pytest
import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.training.shortcuts.gradient_sampling import GradientSizes, with_sampled_gradients

M = 400
NAMES = ("means", "quaternions", "scales", "opacities", "colors")


def leaves(dtype: torch.dtype = torch.float32) -> Gaussians[Tensor]:
    chance = torch.Generator().manual_seed(0)
    shapes = (M, 3), (M, 4), (M, 3), (M,), (M, 3)
    made = [torch.rand(shape, generator=chance).to(dtype).requires_grad_() for shape in shapes]
    return Gaussians(*made)


def gradients(share: float, start: float, sizes: Tensor, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """By the five tensors, of a sum that weighs each primitive by its size [M]; `start` is all chance."""
    given = leaves(dtype)
    found = with_sampled_gradients(given, share, lambda like: torch.full_like(like, start - 0.5))
    chance = torch.Generator().manual_seed(1)
    total = torch.zeros((), dtype=dtype)
    for name in NAMES:
        value, leaf = getattr(found, name), getattr(given, name)
        assert torch.equal(value, leaf)
        weight = torch.randn(value.shape, generator=chance).to(dtype)
        total = total + (value * weight * sizes.to(dtype).view(-1, *[1] * (value.dim() - 1))).sum()
    total.backward()
    return [getattr(given, name).grad for name in NAMES]


def uneven() -> Tensor:
    return 10.0 ** torch.linspace(-4, 0, M)


def test_on_average_the_sample_is_the_gradient():
    sizes = uneven()
    whole = gradients(0.0, 0.0, sizes)
    starts = (np.arange(500) + 0.5) / 500
    sums = [torch.zeros_like(g, dtype=torch.float64) for g in whole]
    for start in starts:
        for total, part in zip(sums, gradients(1.0, float(start), sizes), strict=True):
            total += part
    for total, truth in zip(sums, whole, strict=True):
        # A primitive that is taken with a probability p is there in p 500 of 500 starts, but for one.
        assert (total / len(starts) - truth).abs().max() <= 0.01 * truth.abs().max()


def test_large_gradients_stay_as_they_are_and_most_small_ones_go():
    sizes = uneven()
    whole, sampled = gradients(0.0, 0.0, sizes), gradients(1.0, 0.3, sizes)
    taken = sampled[3] != 0
    large = sizes > 0.5
    for truth, found in zip(whole, sampled, strict=True):
        assert torch.equal(found[large], truth[large])
        assert (found[~taken] == 0).all()
    assert 0.1 * M < int(taken.sum()) < 0.4 * M


def test_all_of_a_primitive_is_taken_as_much_larger_as_it_is_rarer():
    sizes = uneven()
    whole, sampled = gradients(0.0, 0.0, sizes), gradients(1.0, 0.3, sizes)
    factor = (sampled[3] / whole[3]).double()
    small = (factor != 0) & (factor != 1)
    assert int(small.sum()) > 10 and (factor[small] > 1).all()
    for truth, found in zip(whole, sampled, strict=True):
        rows = factor.view(-1, *[1] * (truth.dim() - 1))
        assert torch.allclose(found.double(), truth.double() * rows, rtol=1e-5)


@pytest.mark.parametrize("share", [0.1, 1.0, 100.0])
def test_where_there_is_no_gradient_there_is_none(share):
    for found in gradients(share, 0.9, torch.zeros(M)):
        assert (found == 0).all()


def test_what_is_not_a_number_is_led_on():
    sizes = uneven()
    sizes[7] = float("nan")
    assert any(found[7].isnan().any() for found in gradients(1.0, 0.0, sizes))


def test_other_precisions_have_all_gradients():
    sizes = uneven()
    for found, truth in zip(
        gradients(1.0, 0.5, sizes, torch.float64), gradients(0.0, 0.5, sizes, torch.float64), strict=True
    ):
        assert torch.equal(found, truth)


def test_sizes_of_gradients_are_known_before_they_are_sampled():
    given, weights = leaves(), uneven()
    sizes = GradientSizes()
    found = with_sampled_gradients(given, 0.5, lambda like: torch.zeros_like(like), sizes)
    assert sizes.values is None
    (weights * (3 * found.opacities + found.colors.sum(1)) + weights**2 * found.means.sum(1)).sum().backward()
    scales = given.scales.detach().double()
    shown = 6 * weights.double()
    placed = weights.double() ** 2 * scales.sum(1)
    expected = (shown / shown.mean() + placed / placed.mean()) / 2
    torch.testing.assert_close(sizes.values.double(), expected, rtol=1e-5, atol=0)
