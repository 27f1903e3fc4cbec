"""The mean of a run's last steps, against the steps themselves."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from compgs.config import Config, Phases
from compgs.scene.views import Scene
from compgs.training.structure.averaging import Averaging
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def settings(config: Config, **training: float) -> Config:
    return replace(config, training=replace(config.training, **training))


def parameters(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: p.detach().double().clone() for name, p in trainer.model.named_parameters()}


def steps_of(trainer: Trainer, steps: int) -> list[dict[str, torch.Tensor]]:
    """The parameters after each of so many steps."""
    found = []
    for _ in range(steps):
        trainer.train_step()
        found.append(parameters(trainer))
    return found


def test_a_run_ends_with_the_mean_of_its_last_steps(blob_scene: Scene, tiny_config: Config) -> None:
    trainer = Trainer(blob_scene, settings(tiny_config, phases=Phases(mean=0.8)), CPU)
    every = steps_of(trainer, tiny_config.training.steps)
    trainer.finish()
    last = every[-round(0.2 * tiny_config.training.steps) :]
    assert len(last) == 8
    for name, value in parameters(trainer).items():
        mean = torch.stack([step[name] for step in last]).mean(0)
        assert torch.allclose(value, mean, rtol=1e-5, atol=1e-6), name
    moved = torch.stack([step["references"] for step in last])
    assert (moved[0] != moved[-1]).any(), "the last steps differ, or the mean says nothing"


def test_without_averaging_a_run_ends_where_its_last_step_went(
    blob_scene: Scene, tiny_config: Config
) -> None:
    trainer = Trainer(blob_scene, settings(tiny_config, phases=Phases(mean=1)), CPU)
    last = steps_of(trainer, tiny_config.training.steps)[-1]
    trainer.finish()
    assert all(torch.equal(value, last[name]) for name, value in parameters(trainer).items())


def test_the_mean_begins_anew_after_whatever_else_changes_the_model(
    blob_scene: Scene, tiny_config: Config
) -> None:
    late = settings(tiny_config, phases=Phases(mean=0.5))
    late = replace(late, entropy=replace(late.entropy, decorrelate_at=(0.8,)))
    trainer = Trainer(blob_scene, late, CPU)
    every = steps_of(trainer, late.training.steps)
    turned = round(0.8 * late.training.steps)
    trainer.finish()
    value = parameters(trainer)["references"]
    since = torch.stack([step["references"] for step in every[turned:]]).mean(0)
    assert torch.allclose(value, since, rtol=1e-5, atol=1e-6)


def test_a_run_that_was_stopped_among_its_last_steps_ends_with_the_same_mean(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    config = settings(tiny_config, phases=Phases(mean=0.7))
    whole = Trainer(blob_scene, config, CPU)
    whole.run(None, None)
    first = Trainer(blob_scene, config, CPU)
    steps_of(first, config.training.steps - 5)
    first.save(tmp_path / "checkpoint")
    second = Trainer.resumed(blob_scene, tmp_path / "checkpoint", config, CPU)
    assert second.structure.average.steps == first.structure.average.steps == 7
    second.run(None, None)
    for name, value in parameters(whole).items():
        assert torch.equal(value, parameters(second)[name]), name


@pytest.mark.parametrize("steps", [-1, "3", None, True])
def test_a_number_of_steps_that_is_none_is_refused(steps: object) -> None:
    with pytest.raises(ValueError, match="averaged steps"):
        Averaging(torch.nn.Linear(2, 2)).restore({}, {"averaged": steps})


def test_a_mean_of_other_parameters_is_refused() -> None:
    average = Averaging(torch.nn.Linear(2, 2))
    with pytest.raises(KeyError):
        average.restore({"average/weight": torch.zeros(2, 2)}, {"averaged": 1})
    with pytest.raises(ValueError, match="average weight"):
        average.restore({"average/weight": torch.zeros(3, 2)}, {"averaged": 1})


def test_a_run_that_has_ended_ends_the_same_when_it_is_ended_again(
    blob_scene: Scene, tiny_config: Config
) -> None:
    """A run that is resumed after its last step, as its file was not written, ends once more."""
    trainer = Trainer(blob_scene, settings(tiny_config, phases=Phases(mean=0.8)), CPU)
    steps_of(trainer, tiny_config.training.steps)
    trainer.finish()
    once, mask = parameters(trainer), trainer.model.mask.clone()
    trainer.finish()
    assert torch.equal(trainer.model.mask, mask)
    assert all(torch.equal(value, once[name]) for name, value in parameters(trainer).items())
