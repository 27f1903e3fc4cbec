"""Adam in the eigenbases of the gradients' second moments, for the heads' matrices."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from compgs.config import Config
from compgs.scene.views import Scene
from compgs.training.optimizers import ADAM_EPSILON, BETAS, HEAD_GROUPS
from compgs.training.soap import Soap, forget_bases
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def stepped(start: Tensor, gradients: list[Tensor], rate: float = 0.01) -> tuple[Tensor, dict[str, Tensor]]:
    """A matrix after as many steps as there are gradients, and what is remembered of them."""
    parameter = torch.nn.Parameter(start.clone())
    optimizer = Soap([{"name": "geometry", "params": [parameter], "lr": rate}], HEAD_GROUPS, BETAS, 1e-15)
    for gradient in gradients:
        parameter.grad = gradient.clone()
        optimizer.step()
    return parameter.detach(), optimizer.state[parameter]


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def orthonormal(size: int, seed: int) -> Tensor:
    return torch.linalg.qr(random(size, size, seed=seed))[0]


def test_a_single_number_is_moved_as_by_adam() -> None:
    gradients = [random(1, 1, seed=seed) for seed in range(30)]
    ours, _ = stepped(torch.zeros(1, 1, dtype=torch.float64), gradients)
    theirs = torch.nn.Parameter(torch.zeros(1, 1, dtype=torch.float64))
    adam = torch.optim.Adam([theirs], lr=0.01, betas=BETAS, eps=ADAM_EPSILON)
    for gradient in gradients[1:]:  # the first one only says which axes there are
        theirs.grad = gradient
        adam.step()
    # (the number of steps is in single precision)
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-6, atol=0)


def test_turned_gradients_give_turned_steps() -> None:
    """What Adam does not have: which axes inputs and outputs are counted in says nothing."""
    # Square: of five inputs and three outputs two directions have no gradient in the first step, and no one basis.
    left, right = orthonormal(4, 1), orthonormal(4, 2)
    gradients = [random(4, 4, seed=seed) for seed in range(10, 45)]
    start = random(4, 4, seed=3)
    straight, _ = stepped(start, gradients)
    turned, _ = stepped(left @ start @ right, [left @ g @ right for g in gradients])
    assert (straight - start).abs().max() > 0.05
    torch.testing.assert_close(turned, left @ straight @ right, rtol=0, atol=1e-7)


def test_badly_scaled_directions_are_learned_sooner_than_by_adam() -> None:
    inputs = random(400, 12, seed=4) * torch.logspace(0, -2, 12, dtype=torch.float64) @ orthonormal(12, 5)
    truth = random(12, 4, seed=6)

    def error_after(optimizer_of) -> float:
        weight = torch.nn.Parameter(torch.zeros(12, 4, dtype=torch.float64))
        optimizer = optimizer_of([{"name": "color", "params": [weight], "lr": 0.02}])
        for _ in range(300):
            loss = ((inputs @ (weight - truth)) ** 2).mean()
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
        return float(((inputs @ (weight.detach() - truth)) ** 2).mean())

    soap = error_after(lambda groups: Soap(groups, HEAD_GROUPS, BETAS, ADAM_EPSILON))
    adam = error_after(lambda groups: torch.optim.Adam(groups, lr=0.02, betas=BETAS, eps=ADAM_EPSILON))
    assert soap < 0.25 * adam


def test_forgotten_bases_leave_the_moments_of_adam() -> None:
    """Exact where the gradients lie along the axes: there the bases are the axes themselves."""
    gradients = [
        torch.diag(torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)) * (1 + 0.1 * i) for i in range(9)
    ]
    _, state = stepped(torch.zeros(3, 3, dtype=torch.float64), gradients)
    forget_bases(state)
    expected = torch.zeros(3, 3, dtype=torch.float64)
    for gradient in gradients[1:]:
        expected.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
    torch.testing.assert_close(state["exp_avg_sq"], expected)
    assert not {"left_basis", "right_basis", "left", "right"} & state.keys()


def with_soap(config: Config) -> Config:
    return replace(
        config,
        training=replace(config.training, head_optimizer="soap"),
        entropy=replace(config.entropy, decorrelate_at=(0.1, 0.3)),
    )


@pytest.mark.parametrize("heads", ["paired", "separate"])
def test_a_resumed_run_goes_on_as_if_it_had_not_stopped(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path, heads: str
) -> None:
    config = with_soap(replace(tiny_config, model=replace(tiny_config.model, heads=heads)))
    turns = round(0.3 * config.training.steps)
    whole, first = Trainer(blob_scene, config, CPU), Trainer(blob_scene, config, CPU)
    while whole.step < turns + 15:
        whole.train_step()
    while first.step < turns + 4:
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = Trainer.resumed(blob_scene, tmp_path / "checkpoint.safetensors", config, CPU)
    while second.step < whole.step:
        second.train_step()
    assert any("left_basis" in state for state in second.optimizer.state.values())
    for name, old in whole.model.state_dict().items():
        assert torch.equal(old, second.model.state_dict()[name]), name


def test_only_matrices_of_the_heads_have_bases(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, with_soap(tiny_config), CPU)
    trainer.train_step()
    heads = {p for _, network in trainer.model.heads.networks() for p in network.parameters()}
    for parameter, state in trainer.optimizer.state.items():
        assert ("left_basis" in state) == (parameter in heads and parameter.dim() == 2)
