"""Adam's learning rates, how they fall, and what it remembers."""

import itertools

import pytest
import torch

from compgs.training.optimizers import DECAYS, make_optimizer, set_learning_rates
from compgs.training.start import initial_model


def test_the_first_step_is_the_learning_rate_however_small_a_gradient_is(blob_scene, tiny_config):
    """Gradients of single primitives are tiny: an epsilon of 1e-8 would leave these where they are."""
    model = initial_model(blob_scene, tiny_config)
    optimizer = make_optimizer(model, tiny_config.training)
    before = model.references.detach().clone()
    for name in model.anchor_parameters:
        parameter = getattr(model, name)
        parameter.grad = torch.full_like(parameter, 1e-9)
    optimizer.step()
    moved = before - model.references.detach()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.05), rtol=1e-3, atol=0)


def rates(decay: str, warm_up: float = 0.0) -> list[list[float]]:
    """Learning rates of two groups, "references" and "geometry", at five places of a run."""
    parameters = [torch.nn.Parameter(torch.zeros(1)) for _ in range(2)]
    optimizer = torch.optim.Adam(
        [
            {"name": "references", "params": parameters[:1], "rates": (0.1, 0.001)},
            {"name": "geometry", "params": parameters[1:], "rates": (0.01, 0.01)},
        ]
    )
    found = []
    for progress in (0.0, 0.25, 0.5, 0.75, 1.0):
        set_learning_rates(optimizer, progress, DECAYS[decay], warm_up)
        found.append([group["lr"] for group in optimizer.param_groups])
    return found


def test_the_cosine_falls_by_half_in_the_middle_and_the_exponential_by_the_same_factor_everywhere():
    cosine = [a for a, _ in rates("cosine")]
    assert cosine[0] == pytest.approx(0.1)
    assert cosine[2] == pytest.approx((0.1 + 0.001) / 2)
    assert cosine[4] == pytest.approx(0.001)
    exponential = [a for a, _ in rates("exponential")]
    assert all(b / a == pytest.approx(10**-0.5) for a, b in itertools.pairwise(exponential))


def test_only_heads_warm_up():
    warmed, cold = rates("cosine", warm_up=0.5), rates("cosine")
    assert [a for a, _ in warmed] == [a for a, _ in cold]
    assert [b for _, b in warmed] == pytest.approx([0.0001, 0.0051, 0.01, 0.01, 0.01])


def test_adam_remembers_ten_gradients_and_a_thousand_squares(blob_scene, tiny_config) -> None:
    for group in make_optimizer(initial_model(blob_scene, tiny_config), tiny_config.training).param_groups:
        assert group["betas"] == (0.9, 0.999), group["name"]
