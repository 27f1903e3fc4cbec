"""Runs whose model is not the settings': residuals of their own, more primitives, other networks."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from compgs.codec import decode, encode
from compgs.config import Config
from compgs.scene.views import Scene
from compgs.training.hybrid import train
from compgs.training.run.model_checkpoint import load_checkpoint
from compgs.training.trainer import Trainer


def test_a_run_with_twice_as_many_primitives_resumes_and_encodes_as_if_it_had_not_stopped(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    model = replace(tiny_config.model, residuals=False)
    config = replace(tiny_config, model=model, training=replace(tiny_config.training, lmbda=1e-4))
    device, twice = torch.device("cpu"), 2 * tiny_config.model.coupled_primitives
    whole = Trainer(blob_scene, config, device)
    assert whole.model.mask.shape[1] == twice
    whole.run(None, None)
    first = Trainer(blob_scene, config, device)
    for _ in range(15):
        first.train_step()
    first.save(tmp_path / "checkpoint")
    second = Trainer.resumed(blob_scene, tmp_path / "checkpoint", config, device)
    second.run(None, None)
    encode(whole.model, tmp_path / "whole.cgs")
    encode(second.model, tmp_path / "resumed.cgs")
    assert (tmp_path / "whole.cgs").read_bytes() == (tmp_path / "resumed.cgs").read_bytes()
    assert decode(tmp_path / "whole.cgs").coupled > 0


def test_a_run_with_few_views_trains_encodes_and_resumes_with_residuals_of_its_own(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    model = replace(tiny_config.model, residuals=False)
    config = replace(tiny_config, model=model, training=replace(tiny_config.training, steps=4, lmbda=0.001))
    assert len(blob_scene.train_views) <= 22
    trained = train(blob_scene, config, output=tmp_path, device="cpu")
    assert trained.own_residuals and len(trained.residuals) == trained.anchors
    restored = load_checkpoint(tmp_path / "checkpoint.safetensors").model
    assert restored.own_residuals and torch.equal(restored.residuals, trained.residuals)
    encode(trained, tmp_path / "a.cgs")
    encode(restored, tmp_path / "b.cgs")
    assert (tmp_path / "a.cgs").read_bytes() == (tmp_path / "b.cgs").read_bytes()
    shared = train(blob_scene, replace(config, training=replace(config.training, lmbda=0.003)), device="cpu")
    assert not shared.own_residuals and len(shared.residuals) == 1


def test_a_run_for_a_small_file_trains_resumes_and_encodes_without_a_context(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, lmbda=0.05, rules="all"))
    whole = Trainer(blob_scene, config, torch.device("cpu"))
    assert whole.model.entropy.context_of_references == "none"
    whole.run(None, None)
    first = Trainer(blob_scene, config, torch.device("cpu"))
    for _ in range(15):
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = Trainer.resumed(blob_scene, tmp_path / "checkpoint.safetensors", config, torch.device("cpu"))
    second.run(None, None)
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name
    encode(second.model, tmp_path / "a.cgs")
    trained = second.model.as_hybrid_model().primitives
    decoded = decode(tmp_path / "a.cgs").primitives
    assert sorted(decoded.references.sum(1).tolist()) == pytest.approx(
        sorted(trained.references.sum(1).tolist()), abs=1e-3
    )


def test_a_run_with_separate_networks_trains_encodes_and_resumes(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    model = replace(tiny_config.model, heads="separate")
    config = replace(tiny_config, model=model, training=replace(tiny_config.training, steps=40, lmbda=1e-6))
    trainer = Trainer(blob_scene, config, torch.device("cpu"))
    trainer.train_step()
    assert trainer.model.dimensions.heads == "separate"
    trainer.save(tmp_path / "checkpoint.safetensors")
    restored = load_checkpoint(tmp_path / "checkpoint.safetensors").model
    assert restored.dimensions.heads == "separate"
    encode(restored, tmp_path / "a.cgs")
    assert decode(tmp_path / "a.cgs").heads.layout == "separate"
