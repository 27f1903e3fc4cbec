from dataclasses import replace

import pytest
import torch

from compgs.training.control import AdaptiveControl, make_schedule, rate_weight
from compgs.training.initial import initial_model
from compgs.training.optimizers import make_optimizer
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


def ready(scene, config):
    trainer = Trainer(scene, config, CPU)
    for _ in range(3):
        trainer.train_step()
    return trainer


def test_growth_never_duplicates_a_position_and_keeps_to_the_limit(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    control, model = trainer.control, trainer.model
    generator = torch.Generator().manual_seed(0)
    before = model.anchors
    control.drawn[:] = 1000
    control.gradient[:] = 1e6
    control.act(model, trainer.optimizer, trainer.coupled_means() * 1.7 + 0.13, generator, 0.004)
    assert model.anchors > before
    assert len(torch.unique(model.coordinates, dim=0)) == model.anchors


def test_the_number_of_anchors_has_a_limit_that_holds(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    limit = trainer.model.anchors + 7
    trainer.control.config = replace(tiny_config, model=replace(tiny_config.model, max_anchors=limit))
    trainer.control.drawn[:] = 1000
    trainer.control.gradient[:] = 1e6
    trainer.control.act(
        trainer.model, trainer.optimizer, trainer.coupled_means() * 2, torch.Generator().manual_seed(0), 0.004
    )
    assert trainer.model.anchors == limit


def test_transparent_anchors_are_removed_with_their_moments(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    control, model = trainer.control, trainer.model
    gone = torch.zeros(model.anchors, dtype=torch.bool)
    gone[::3] = True
    control.seen[:] = 100
    control.opacity[:] = torch.where(gone, 0.0, 50.0)
    control.drawn[:] = 0
    expected = {name: getattr(model, name).detach()[~gone] for name in model.anchor_parameters}
    moments = {
        name: trainer.optimizer.state[getattr(model, name)]["exp_avg"][~gone]
        for name in model.anchor_parameters
    }
    means = trainer.coupled_means()
    control.act(model, trainer.optimizer, means, torch.Generator().manual_seed(0), 0.004)
    for name in model.anchor_parameters:
        parameter = getattr(model, name)
        assert torch.equal(parameter.detach(), expected[name])
        assert torch.equal(trainer.optimizer.state[parameter]["exp_avg"], moments[name])
        assert any(parameter is p for group in trainer.optimizer.param_groups for p in group["params"])
    trainer.train_step()


def test_a_scene_whose_anchors_are_all_transparent_keeps_them(blob_scene, tiny_config):
    trainer = ready(blob_scene, tiny_config)
    before = trainer.model.anchors
    trainer.control.seen[:] = 100
    trainer.control.opacity[:] = 0
    trainer.control.drawn[:] = 0
    trainer.control.act(trainer.model, trainer.optimizer, trainer.coupled_means(), torch.Generator(), 0.004)
    assert trainer.model.anchors == before


def test_an_anchor_has_to_add_more_where_bits_weigh_more(tiny_config):
    control = replace(tiny_config.control, rate_exponent=0.5)
    assert rate_weight(control, 0.002) == pytest.approx(1)
    assert rate_weight(control, 0.008) == pytest.approx(2)
    assert rate_weight(control, 0.0) == rate_weight(control, 1e-6) < 0.1  # without a rate, too, growth ends
    assert rate_weight(replace(control, rate_exponent=0.0), 0.008) == 1


def test_the_schedule_scales_with_the_run(tiny_config):
    short = make_schedule(tiny_config.control, 1_000, 20)
    long = make_schedule(tiny_config.control, 10_000, 20)
    assert (long.start, long.stop, long.every) == (10 * short.start, 10 * short.stop, 10 * short.every)
    assert make_schedule(tiny_config.control, 100, 300).every == 300


def test_statistics_follow_the_anchors(blob_scene, tiny_config):
    model = initial_model(blob_scene, tiny_config)
    control = AdaptiveControl(tiny_config, make_schedule(tiny_config.control, 40, 8), model.anchors, CPU)
    assert control.gradient.shape == (model.anchors, 4)
    assert make_optimizer(model, tiny_config.training).param_groups[0]["name"] == "log_scales"
