"""Adam for the anchors in view, and how learning rates fall."""

import itertools
from dataclasses import replace

import numba
import pytest
import torch

from compgs.training.initial import initial_model
from compgs.training.optimizers import (
    DECAYS,
    adam_rows,
    make_optimizer,
    set_learning_rates,
    step_rows,
)
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def run(scene, config, views: list[torch.Tensor], step) -> dict[str, torch.Tensor]:
    """Parameters and moments after one step a view, gradients being random where the view has anchors."""
    model = initial_model(scene, config)
    optimizer = make_optimizer(model, config.training)
    noise = torch.Generator().manual_seed(0)
    for rows in views:
        for name in model.anchor_parameters:
            parameter = getattr(model, name)
            parameter.grad = torch.zeros_like(parameter)
            parameter.grad[rows] = torch.randn(len(rows), parameter.shape[1], generator=noise)
        step(model, optimizer, rows)
    result = {}
    for name in model.anchor_parameters:
        parameter = getattr(model, name)
        state = optimizer.state[parameter]
        result |= {name: parameter.detach(), f"{name}/1": state["exp_avg"], f"{name}/2": state["exp_avg_sq"]}
    return result


def dense(model, optimizer, rows):
    optimizer.step()


def sparse(model, optimizer, rows):
    step_rows(model, optimizer, rows)
    assert all(getattr(model, name).grad is None for name in model.anchor_parameters)


def plain(model, optimizer, rows):
    """`adam_rows`, as on a GPU."""
    for group in optimizer.param_groups[: len(model.anchor_parameters)]:
        (p,) = group["params"]
        state = optimizer.state[p]
        if not state:
            state |= {"step": torch.zeros(()), "exp_avg": torch.zeros_like(p)}
            state["exp_avg_sq"] = torch.zeros_like(p)
        state["step"] += 1
        parts = p.detach(), p.grad, state["exp_avg"], state["exp_avg_sq"]
        adam_rows(rows, *parts, state["step"], group)


def close(found, expected):
    for name, value in expected.items():
        torch.testing.assert_close(
            found[name], value, atol=5e-7, rtol=2e-5, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_with_all_anchors_in_view_it_is_torchs_adam(blob_scene, tiny_config):
    everything = [torch.arange(initial_model(blob_scene, tiny_config).anchors)] * 5
    expected = run(blob_scene, tiny_config, everything, dense)
    close(run(blob_scene, tiny_config, everything, sparse), expected)
    close(run(blob_scene, tiny_config, everything, plain), expected)


def some_views(scene, config) -> list[torch.Tensor]:
    n, chance = initial_model(scene, config).anchors, torch.Generator().manual_seed(1)
    return [torch.nonzero(torch.rand(n, generator=chance) < 0.4).view(-1) for _ in range(5)]


def test_the_kernel_does_what_plain_torch_does(blob_scene, tiny_config):
    views = some_views(blob_scene, tiny_config)
    close(run(blob_scene, tiny_config, views, sparse), run(blob_scene, tiny_config, views, plain))


def test_anchors_out_of_view_keep_their_values_and_moments(blob_scene, tiny_config):
    views = some_views(blob_scene, tiny_config)
    before = run(blob_scene, tiny_config, views[:4], sparse)
    after = run(blob_scene, tiny_config, views, sparse)
    unseen = torch.ones(len(before["references"]), dtype=torch.bool)
    unseen[views[4]] = False
    for name, value in before.items():
        assert torch.equal(after[name][unseen], value[unseen])
        assert not torch.equal(after[name], value)


@pytest.mark.parametrize("step", [dense, sparse])
def test_the_first_step_is_the_learning_rate_however_small_a_gradient_is(blob_scene, tiny_config, step):
    """Gradients of single primitives are tiny: an epsilon of 1e-8 would leave these where they are."""
    model = initial_model(blob_scene, tiny_config)
    optimizer = make_optimizer(model, tiny_config.training)
    before = model.references.detach().clone()
    for name in model.anchor_parameters:
        parameter = getattr(model, name)
        parameter.grad = torch.full_like(parameter, 1e-9)
    step(model, optimizer, torch.arange(model.anchors))
    moved = before - model.references.detach()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.05), rtol=1e-3, atol=0)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core")
def test_the_same_bits_with_one_thread_and_with_two(blob_scene, tiny_config):
    views = some_views(blob_scene, tiny_config)
    two = run(blob_scene, tiny_config, views, sparse)
    numba.set_num_threads(1)
    try:
        one = run(blob_scene, tiny_config, views, sparse)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for name, value in one.items():
        assert torch.equal(value, two[name])


def test_a_run_with_sparse_adam_learns(blob_scene, tiny_config):
    config = replace(tiny_config, training=replace(tiny_config.training, sparse_adam=True, steps=100))
    trainer = Trainer(blob_scene, config, CPU)
    losses = [float(trainer.train_step().loss) for _ in range(100)]
    assert sum(losses[-10:]) < 0.7 * sum(losses[:10])


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


@pytest.mark.parametrize("memory", [50.0, 1000.0])
def test_squares_are_remembered_as_long_as_the_setting_says_of_anchors_and_of_nothing_else(
    blob_scene, tiny_config, memory: float
) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, anchor_memory=memory))
    model = initial_model(blob_scene, config)
    for group in make_optimizer(model, config.training).param_groups:
        steps = memory if group["name"] in model.anchor_parameters else 1000.0
        assert group["betas"] == (0.9, 1 - 1 / steps), group["name"]
