"""Primitives that are left out of a step by chance."""

import numpy as np
import pytest
import torch

from compgs.entropy.quantization import UniformNoise
from compgs.gaussians import Gaussians
from compgs.tensors.prediction import Prediction
from compgs.training.step.dropout import thinned


def every_other(count: int, opacity: float) -> Prediction:
    """Of twice as many coupled primitives every second one is predicted."""
    zero = torch.zeros(count, 3)
    drawn = torch.full((count,), opacity).requires_grad_()
    gaussians = Gaussians(zero, torch.ones(count, 4), zero + 0.1, drawn, zero + 0.5)
    return Prediction(gaussians, 2 * torch.arange(count), torch.zeros(2 * count))


def noise() -> UniformNoise:
    return UniformNoise(0, np.random.default_rng(0))


@pytest.mark.parametrize("share", [0.04, 0.2])
def test_that_share_is_left_out_and_the_opacity_of_all_together_stays(share: float) -> None:
    before = every_other(100_000, 0.5)
    after = thinned(before, share, noise())
    gone = after.opacities == 0
    assert gone.float().mean().item() == pytest.approx(share, rel=0.05)
    assert after.opacities.mean().item() == pytest.approx(0.5, rel=0.01)
    assert after.means is before.gaussians.means
    after.opacities.sum().backward()
    gradient = before.gaussians.opacities.grad
    assert gradient is not None
    assert torch.equal(gradient == 0, gone)


def test_no_opacity_reaches_one_and_none_is_left_out_where_none_should_be() -> None:
    assert float(thinned(every_other(1000, 0.95), 0.2, noise()).opacities.detach().max()) == pytest.approx(
        0.9999
    )
    same = every_other(10, 0.5)
    assert thinned(same, 0.0, noise()) is same.gaussians
