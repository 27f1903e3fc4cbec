"""Residual embeddings of their own."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from compgs.codec import decode, encode
from compgs.config import Config, load_config
from compgs.scene.views import Scene
from compgs.training.checkpoint import load_checkpoint
from compgs.training.own_residuals import coupled_primitives, own_residuals
from compgs.training.trainer import Trainer, train


def asked(**training: object) -> Config:
    return replace(Config(), training=replace(Config().training, **training))


def test_anchors_have_their_own_residuals_where_few_views_look_and_bits_are_cheap() -> None:
    cheap, dear = asked(lmbda=0.001), asked(lmbda=0.005)
    assert [own_residuals(cheap, 2000, views) for views in (12, 22, 23, 100)] == [True, True, False, False]
    assert not own_residuals(dear, 2000, 12)
    assert own_residuals(load_config("paper"), 2000, 100), "as published"


@pytest.mark.parametrize(
    ("lmbda", "steps", "per_step", "own"),
    [(1e-5, 4500, 1, True), (1e-5, 4499, 1, False), (1e-5, 1125, 4, True), (2e-5, 30_000, 1, False)],
)
def test_where_many_views_look_they_have_them_in_long_runs_and_where_bits_cost_next_to_nothing(
    lmbda: float, steps: int, per_step: int, own: bool
) -> None:
    assert own_residuals(asked(lmbda=lmbda, steps=steps, views_per_step=per_step), 2000, 100) == own


@pytest.mark.parametrize(("views", "least"), [(12, 24_000), (100, 80_000)])
def test_a_size_that_is_asked_for_decides_by_its_bytes_for_an_anchor(views: int, least: int) -> None:
    large, small = asked(target_bytes=least, lmbda=1.0), asked(target_bytes=least - 1, lmbda=0.0)
    assert own_residuals(large, 2000, views) and not own_residuals(small, 2000, views)


@pytest.mark.parametrize("training", [{"lmbda": 0.0}, {"target_bytes": 10**9}])
@pytest.mark.parametrize(("setting", "views"), [("residuals_where_few", 12), ("residuals_where_many", 100)])
def test_a_limit_of_zero_keeps_residuals_shared(training: dict[str, float], setting: str, views: int) -> None:
    config = asked(**training)
    assert own_residuals(config, 2000, views)
    config = replace(config, model=replace(config.model, **{setting: 0.0}))
    assert not own_residuals(config, 2000, views)


@pytest.mark.parametrize(
    ("training", "views", "expected"),
    [
        ({"lmbda": 1e-4}, 22, 10),
        ({"lmbda": 1e-4}, 23, 5),
        ({"lmbda": 2e-4}, 12, 5),
        ({"lmbda": 1.0, "target_bytes": 120_000}, 12, 10),
        ({"lmbda": 0.0, "target_bytes": 119_999}, 12, 5),
    ],
)
def test_anchors_have_twice_as_many_primitives_where_few_views_look_and_bits_are_cheaper_still(
    training: dict[str, float], views: int, expected: int
) -> None:
    config = asked(**training)
    assert coupled_primitives(config, 2000, views) == expected
    assert (
        coupled_primitives(
            replace(config, model=replace(config.model, twice_coupled_where_few=0)), 2000, views
        )
        == 5
    )
    assert coupled_primitives(load_config("paper"), 2000, views) == 10, "as published"
    assert coupled_primitives(
        replace(config, model=replace(config.model, coupled_primitives=40)), 2000, views
    ) == (64 if expected == 10 else 40), "as many as a file can hold"


def test_a_run_with_twice_as_many_primitives_resumes_and_encodes_as_if_it_had_not_stopped(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    model = replace(tiny_config.model, residuals=False, twice_coupled_where_few=1e-4)
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
    model = replace(tiny_config.model, residuals=False, residuals_where_few=0.002)
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
    model = replace(tiny_config.model, networks_by_price=True)
    config = replace(tiny_config, model=model, training=replace(tiny_config.training, lmbda=0.05))
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


def test_a_long_run_at_the_top_trains_encodes_and_resumes_with_separate_networks(
    blob_scene: Scene, tiny_config: Config, tmp_path: Path
) -> None:
    model = replace(tiny_config.model, heads="paired", residuals=False)
    config = replace(tiny_config, model=model, training=replace(tiny_config.training, steps=4, lmbda=1e-6))
    many = replace(blob_scene, train_views=blob_scene.train_views * 4)
    passes = replace(config, training=replace(config.training, steps=45 * len(many.train_views)))
    trainer = Trainer(many, passes, torch.device("cpu"))
    trainer.train_step()
    assert trainer.model.dimensions.heads == "separate" and trainer.model.own_residuals
    trainer.save(tmp_path / "checkpoint.safetensors")
    restored = load_checkpoint(tmp_path / "checkpoint.safetensors").model
    assert restored.dimensions.heads == "separate"
    encode(restored, tmp_path / "a.cgs")
    assert decode(tmp_path / "a.cgs").heads.layout == "separate"
