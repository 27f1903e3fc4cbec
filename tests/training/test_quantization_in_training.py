"""Soft, then hard: rendering sees latents with noise for a part of the run, and what the file will hold after it."""

from dataclasses import replace

import pytest
import torch

from compgs.config import Config, check_config
from compgs.entropy import Quantized
from compgs.errors import ConfigError
from compgs.scene.views import Scene
from compgs.trained_model import TrainedModel
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.mark.parametrize("residuals", [True, False])
def test_noise_in_place_of_rounding_is_half_a_step_at_most_and_costs_the_same_bits(
    blob_scene: Scene, tiny_config: Config, residuals: bool
) -> None:
    config = replace(tiny_config, model=replace(tiny_config.model, residuals=residuals))
    model = Trainer(blob_scene, config, CPU).model
    with torch.no_grad():
        model.references.normal_(0, 5, generator=torch.Generator().manual_seed(0))

    def third(like: torch.Tensor) -> torch.Tensor:
        return torch.full_like(like, 0.3)

    soft = model.quantized(rate=True, noise=third, soft=True)
    hard = model.quantized(rate=True, noise=third)
    for name, bits in hard.bits.items():
        assert torch.equal(soft.bits[name], bits), name
    assert torch.equal(soft.references, model.references + 0.3)
    assert torch.equal(soft.covariances, model.log_scales / model.entropy.covariance_step + 0.3)
    assert (hard.references - model.references).abs().max() <= 0.5 + 1e-4
    if residuals:
        assert torch.equal(soft.residuals, model.residuals + 0.3)
    else:  # constants of the file: nothing is rounded
        assert torch.equal(soft.residuals, hard.residuals)


def test_rendering_is_soft_until_its_share_of_the_run_and_hard_from_then_on(
    blob_scene: Scene, tiny_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = replace(tiny_config.training, steps=20, hard_rendering=0.25, hard_rate=0.8)
    trainer = Trainer(blob_scene, replace(tiny_config, training=training), CPU)
    seen: list[tuple[bool, bool]] = []
    quantized = TrainedModel.quantized

    def spy(
        self: TrainedModel, rows: torch.Tensor | None = None, *, soft: bool = False, **more: object
    ) -> Quantized:
        if torch.is_grad_enabled():
            seen.append((soft, more.get("noise") is not None))
        return quantized(self, rows, soft=soft, **more)

    monkeypatch.setattr(TrainedModel, "quantized", spy)
    for _ in range(20):
        trainer.train_step()
    assert seen == [(True, True)] * 5 + [(False, True)] * 11 + [(False, False)] * 4


def test_noise_is_given_up_in_rendering_before_it_is_in_the_likelihood(tiny_config: Config) -> None:
    training = replace(tiny_config.training, hard_rendering=0.6, hard_rate=0.5)
    with pytest.raises(
        ConfigError, match=r"training\.hard_rendering = 0\.6: expected 0 to training\.hard_rate, 0\.5"
    ):
        check_config(replace(tiny_config, training=training))
