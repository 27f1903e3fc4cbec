"""Runs whose references are coded around their neighbours: enough anchors for several ranges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.codec import decode, encode
from compgs.codec.content import Role, dequantize
from compgs.codec.encoder import encoded
from compgs.codec.reader import file_info
from compgs.codec.reduce import without_coupled
from compgs.config import Config
from compgs.scene.points import Points
from compgs.scene.views import Scene
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture
def scene(blob_scene: Scene) -> Scene:
    """The blobs' points, each twelve times, a little apart."""
    rng = np.random.default_rng(0)
    positions = np.repeat(blob_scene.points.positions, 12, 0)
    positions = positions + rng.normal(0, 0.15, positions.shape)
    return replace(blob_scene, points=Points(positions, np.repeat(blob_scene.points.colors, 12, 0)))


@pytest.fixture
def config(tiny_config: Config) -> Config:
    return replace(
        tiny_config,
        model=replace(tiny_config.model, residuals=False, voxel_size=0.05),
        training=replace(tiny_config.training, steps=30, lmbda=2e-3),
    )


@pytest.fixture
def trained(scene: Scene, config: Config) -> Trainer:
    trainer = Trainer(scene, config, CPU)
    assert trainer.model.entropy.context_of_references == "neighbours"
    trainer.run(None, None)
    return trainer


def test_the_network_of_the_neighbours_learns_and_latents_do_not_learn_from_it(
    scene: Scene, config: Config
) -> None:
    trainer = Trainer(scene, config, CPU)
    network = trainer.model.entropy.neighbour_network
    assert network is not None
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    trainer.step = 12  # the rate is in the loss
    now = trainer.now
    looks = trainer.views_of_step(now)
    trainer.learn(looks, now)
    gradients = trainer.model.references.grad
    assert gradients is not None and network.follow.grad is not None
    without = gradients.clone()
    trainer.latents.learn_neighbours(trainer.latents.quantize(looks, now), looks)
    assert torch.equal(without, trainer.model.references.grad)
    trainer.update(looks.views, torch.zeros(()))
    assert all(not torch.equal(p, before[name]) for name, p in network.named_parameters())


def test_what_was_trained_is_what_the_file_decodes_to(trained: Trainer, tmp_path: Path) -> None:
    """Anchor by anchor: neighbours change what a latent costs, and not what it is."""
    encode(trained.model, tmp_path / "a.cgs")
    info = file_info((tmp_path / "a.cgs").read_bytes())
    assert info.version == 5 and len(info.ranges) > 1
    mine, theirs = trained.model.as_hybrid_model().primitives, decode(tmp_path / "a.cgs").primitives
    rows = {tuple(p): i for i, p in enumerate(mine.positions.tolist())}
    order = [rows[tuple(p)] for p in theirs.positions.tolist()]
    np.testing.assert_allclose(theirs.references, mine.references[order], atol=1e-3)


def test_the_estimated_size_is_that_of_the_files_streams_whose_rows_say_nothing(
    trained: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained.model, "row_context", False)
    data, _ = encoded(trained.model)
    sections = {section.name: section.bytes for section in file_info(data).sections}
    estimated = trained.model.estimated_bits()
    assert estimated.keys() == {"reference", "covariance"}
    expected = sections["reference embeddings"] + sections["log scales"]
    states = 24 * len(file_info(data).ranges)
    assert sum(estimated.values()) / 8 == pytest.approx(expected, rel=0.02, abs=states)


def test_a_run_that_is_interrupted_goes_on_as_if_it_had_not_been(
    trained: Trainer, scene: Scene, config: Config, tmp_path: Path
) -> None:
    first = Trainer(scene, config, CPU)
    for _ in range(14):
        first.train_step()
    first.save(tmp_path / "checkpoint.safetensors")
    second = Trainer.resumed(scene, tmp_path / "checkpoint.safetensors", config, CPU)
    second.run(None, None)
    for name, value in trained.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name


def test_without_some_primitives_the_others_stay_what_they_are(trained: Trainer) -> None:
    _, content = encoded(trained.model)
    kept = np.random.default_rng(1).random(int(content.mask.sum())) < 0.1
    smaller = without_coupled(content, kept)
    assert 0 < len(smaller.coordinates) < 0.8 * len(content.coordinates)
    rows = {tuple(place): i for i, place in enumerate(content.coordinates.tolist())}
    were = [rows[tuple(place)] for place in smaller.coordinates.tolist()]
    for before, after in zip(dequantize(content), dequantize(smaller), strict=True):
        assert np.array_equal(before[were], after)
    references = smaller.group(Role.REFERENCE).symbols
    assert not np.array_equal(content.group(Role.REFERENCE).symbols[were], references)


def test_the_network_of_the_neighbours_learns_of_an_even_sample_where_anchors_are_many(
    scene: Scene, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it learns of is some of what all anchors would say, whatever else the step does."""
    found = []
    for most in (1 << 20, 20):
        monkeypatch.setattr("compgs.training.step.latents.LEARNED_FROM", most)
        trainer = Trainer(scene, config, CPU)
        trainer.step = 24  # symbols are in the likelihood: no noise
        now = trainer.now
        looks = trainer.views_of_step(now)
        assert now.hard and now.rate_weight
        latents = trainer.latents.quantize(looks, now)
        found.append((looks, latents, trainer.latents.sample_of(looks)))
        trainer.latents.learn_neighbours(latents, looks)
        network = trainer.model.entropy.neighbour_network
        assert network is not None and network.follow.grad is not None and network.follow.grad.abs().max() > 0
    (looks, all_of_them, everything), (_, some, sample) = found
    assert everything is None and sample is not None
    assert len(looks.own.rows) / 2 > len(sample) > 10 and len(sample) <= 20
    assert all_of_them.neighbour_bits is not None and some.neighbour_bits is not None
    torch.testing.assert_close(some.neighbour_bits, all_of_them.neighbour_bits[sample])
    for name, bits in all_of_them.bits.items():
        assert torch.equal(bits, some.bits[name])
