"""A run whose networks are smaller because their bits are dear."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import compgs
from compgs.config import Config
from compgs.scene.views import Scene
from compgs.training.plan import head_bits
from compgs.training.run.model_checkpoint import load_checkpoint
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture
def priced(tiny_config: Config) -> Config:
    return replace(tiny_config, training=replace(tiny_config.training, rules="all"))


def of_lambda(config: Config, lmbda: float) -> Config:
    return replace(config, training=replace(config.training, lmbda=lmbda))


def test_the_file_has_the_width_and_no_weight_of_more_bits(
    blob_scene: Scene, priced: Config, tmp_path: Path
) -> None:
    trainer = Trainer(blob_scene, priced, CPU)
    start = trainer.model.anchors
    while trainer.step < priced.training.steps:
        trainer.train_step()
    trainer.finish()
    model = trainer.model
    bits = head_bits(priced, trainer.plan.start, priced.training.lmbda, model.anchors)
    assert trainer.plan.start.anchors == start and trainer.plan.width == 8
    assert (model.dimensions.width, model.head_bits) == (8, bits) and bits < 7
    compgs.encode(model, tmp_path / "priced.cgs")
    decoded = compgs.decode(tmp_path / "priced.cgs", "cpu")
    for name, tensor in decoded.heads.tensors.items():
        if tensor.ndim > 1 and np.abs(tensor).max() > 0 and "residual" not in name:
            levels = tensor / np.diff(np.unique(tensor)).min()  # two of so many weights are neighbours
            assert np.abs(levels - np.rint(levels)).max() < 1e-3 and np.abs(levels).max() < 1 << (bits - 1), (
                name
            )
    ours = compgs.render(model.as_hybrid_model(), blob_scene.train_views[0].camera).image
    theirs = compgs.render(decoded, blob_scene.train_views[0].camera).image
    assert np.abs(np.asarray(ours) - np.asarray(theirs)).max() < 1e-2


def test_a_run_that_goes_on_keeps_width_and_bits(blob_scene: Scene, priced: Config, tmp_path: Path) -> None:
    whole = Trainer(blob_scene, priced, CPU)
    for _ in range(36):
        whole.train_step()
    whole.save(tmp_path / "checkpoint")
    saved = load_checkpoint(tmp_path / "checkpoint").model
    assert (saved.dimensions.width, saved.head_bits) == (whole.model.dimensions.width, whole.model.head_bits)
    again = Trainer.resumed(blob_scene, tmp_path / "checkpoint", priced, CPU)
    for trainer in (whole, again):
        trainer.train_step()
    assert again.model.head_bits == whole.model.head_bits < 7
    for name, parameter in whole.model.named_parameters():
        assert torch.equal(parameter, again.model.get_parameter(name)), name


def test_bits_are_settled_once_the_networks_compute_with_them(blob_scene: Scene, priced: Config) -> None:
    trainer = Trainer(blob_scene, of_lambda(priced, 1e-9), CPU)
    assert trainer.model.head_bits == 7
    trainer.rate = replace(trainer.rate, lmbda=1.0)
    trainer.structure.follow(trainer.step, trainer.rate, stored=trainer.now.stored)
    assert trainer.model.head_bits == 6
    trainer.step = int(priced.training.borders.weights * priced.training.steps)
    trainer.rate = replace(trainer.rate, lmbda=1e-9)
    trainer.structure.follow(trainer.step, trainer.rate, stored=trainer.now.stored)
    assert trainer.model.head_bits == 6
