"""COSA-GS: exact files, honest estimates, masks inside the rate, runs that go on, damaged files that are refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compgs.codec.integer_network import FRACTION_BITS
from compgs.config import Config
from compgs.errors import CompGSError, NotEncodable, SplatFileError
from compgs.exporting import export
from compgs.formats import packed
from compgs.methods import METHODS, settings_of, train, write
from compgs.methods.cosa.model import CosaModel
from compgs.methods.cosa.settings import CosaConfig
from compgs.methods.cosa.trainer import BITS_PER_MEGABYTE, CosaTrainer
from compgs.methods.cosa.writer import packed_content
from compgs.opening import component_bytes, open_scene
from compgs.published.cosa import reader
from compgs.published.cosa.chain import coordinate_inputs
from compgs.published.cosa.shape import GROUPS
from compgs.render import render
from compgs.scene.views import Scene

CPU = torch.device("cpu")


def settings(steps: int = 90, lmbda: float = 2.0, **cosa: Any) -> CosaConfig:
    """Small networks, so that a small file is about its anchors, and masks that are quick."""
    base = settings_of("cosa-gs")
    assert isinstance(base, CosaConfig)
    return replace(
        base,
        model=replace(base.model, coupled_primitives=4, reference_dim=8, width=8),
        control=replace(base.control, gradient_threshold=1e-6, minimum_views=2),
        training=replace(base.training, steps=steps, seed=3, lmbda=lmbda),
        cosa=replace(base.cosa, **{"mask_lr": (0.3, 0.3), "context_dim": 8, **cosa}),
    )


@pytest.fixture(scope="module")
def trained(blob_scene: Scene) -> CosaModel:
    return train(blob_scene, settings(), method="cosa-gs", device="cpu")


@pytest.fixture
def file(trained: CosaModel, tmp_path: Path) -> Path:
    path = tmp_path / "a.packed"
    write(trained, path, method="cosa-gs")
    return path


def test_presets_differ_in_what_they_are_for() -> None:
    default, paper, quick = (settings_of("cosa-gs", name) for name in ("default", "paper", "quick"))
    assert default.training.lmbda == paper.training.lmbda == quick.training.lmbda
    assert default.control == paper.control == quick.control != Config().control
    assert (default.model.coupled_primitives, paper.model.coupled_primitives) == (5, 10)
    assert isinstance(paper, CosaConfig) and (paper.cosa.head_bits, paper.cosa.symbols_start) == (16, 1.0)
    steps = Config().training.steps, 30_000, 4_000
    assert (default.training.steps, paper.training.steps, quick.training.steps) == steps


def test_the_suffix_is_the_containers() -> None:
    assert METHODS["cosa-gs"].suffix == packed.SUFFIX


# the file ---------------------------------------------------------------------------------------------------------


def test_a_file_holds_the_symbols_that_were_written_and_shows_what_was_trained(
    trained: CosaModel, file: Path, blob_scene: Scene
) -> None:
    written, read = trained.content(), reader.content_of(packed.read(file))
    assert 0 < read.mask.sum() < read.mask.size, "no mask fell: the test is too weak"
    assert len(written.symbols) == 4 + 4
    for name in ("symbols", "tables"):
        for ours, theirs in zip(getattr(written, name), getattr(read, name), strict=True):
            assert np.array_equal(ours, theirs)
    for group in GROUPS:
        assert np.array_equal(written.latents[group], read.latents[group])
    for name in ("coordinates", "mask"):
        assert np.array_equal(getattr(written, name), getattr(read, name))
    assert (read.frame, read.steps, read.shape) == (written.frame, written.steps, written.shape)
    opened, shown = open_scene(file), trained.as_hybrid_model()
    for view in blob_scene.test_views:
        assert np.array_equal(render(opened, view.camera).image, render(shown, view.camera).image)
    assert opened.counts == {"anchors": len(read.coordinates), "coupled_primitives": int(read.mask.sum())}
    assert sum(component_bytes(file).values()) == file.stat().st_size


def test_what_the_file_has_is_what_training_saw_but_for_the_rounding(trained: CosaModel) -> None:
    """Half a step at most, and a little where the integer networks round a mean to the other side."""
    content = trained.content()
    place = {tuple(c): i for i, c in enumerate(trained.coordinates.tolist())}
    rows = [place[tuple(c)] for c in content.coordinates.tolist()]
    for group in ("latent", "feature", "position_scale", "size"):
        y = trained.natural()[group].detach()[rows] / trained.chain.step(group).detach()
        away = np.abs(content.latents[group] / (1 << FRACTION_BITS) - y.numpy())
        assert away.max() <= 0.5 + 1e-3
        assert away.mean() > 0.02, "nothing was rounded"


def test_the_integer_chain_is_the_float_chain(trained: CosaModel) -> None:
    """Values of one are those of the other, but for what falls to the other side of a rounding."""
    content = trained.content()
    place = {tuple(c): i for i, c in enumerate(trained.coordinates.tolist())}
    rows = [place[tuple(c)] for c in content.coordinates.tolist()]
    with torch.no_grad():
        values = trained.chained(None, rate=False).values
    for group in ("latent", "feature", "position_scale", "size"):
        away = np.abs(content.latents[group] / (1 << FRACTION_BITS) - values[group].numpy()[rows])
        assert (away < 0.02).mean() > 0.98, group


def test_the_estimate_is_the_size_of_the_file(trained: CosaModel, file: Path) -> None:
    with torch.no_grad():
        bits = trained.chained(None).bits
        kept = trained.kept().float()
        own = sum(cost for name, cost in bits.items() if name != "offset") * kept.amax(1)
        latents = float(own.sum() + (bits["offset"] * kept).sum()) / 8
    framing = 8 * 8  # bytes: of eight streams, each with a state and its length
    assert component_bytes(file)["latents"] == pytest.approx(latents + framing, rel=0.03)
    assert file.stat().st_size == pytest.approx(trained.estimated_bytes(), rel=0.06)


def test_a_trained_file_is_small(file: Path, trained: CosaModel) -> None:
    """Half a byte for each number of an anchor, or less."""
    numbers = trained.anchors * (4 + 8 + 1 + 3) + 3 * int(trained.mask.sum())
    assert component_bytes(file)["latents"] < 0.6 * numbers


def test_coordinates_are_inputs_between_minus_one_and_one() -> None:
    corner = np.array([-16, 0, 32])
    inputs = coordinate_inputs(corner + np.array([[0, 0, 0], [7, 7, 7], [4, 4, 4], [99, -9, 0]]), corner, 3)
    assert inputs[:3].tolist() == [[-3584] * 3, [3584] * 3, [512] * 3]  # (2 i + 1) / 8 - 1, in 2^-12
    assert inputs[3].tolist() == [3584, -3584, -3584]  # what left the cube stays at its side


# training ---------------------------------------------------------------------------------------------------------


def test_the_first_phase_has_no_rate_and_grows(blob_scene: Scene) -> None:
    trainer = CosaTrainer(blob_scene, settings(), CPU, "cosa-gs")
    before = trainer.model.anchors
    while trainer.step < trainer.rate_at:
        trainer.train_step()
    model = trainer.model
    assert model.anchors > before and not model.begun
    assert model.latents.abs().sum() == 0 and trainer.added() is None
    grown = model.anchors
    trainer.train_step()
    assert model.begun and model.latents.abs().sum() > 0 and model.anchors == grown


def test_rendering_sees_noise_of_half_a_step_in_the_second_phase(blob_scene: Scene) -> None:
    trainer = CosaTrainer(blob_scene, settings(), CPU, "cosa-gs")
    trainer.step = trainer.rate_at
    seen, model = trainer.values(), trainer.model
    away = (seen.features - model.features).detach().abs() / model.chain.step("feature").item()
    assert 0.45 < away.max() <= 0.5 + 1e-3 and 0.2 < away.mean() < 0.3
    away = (seen.sizes - model.log_scales[:, 1:]).detach().abs() / model.chain.step("size").item()
    assert 0.4 < away.max() <= 0.5 + 1e-3


def test_noise_in_the_bits_alone_leaves_rendering_what_the_file_will_have(trained: CosaModel) -> None:
    def noise(like: torch.Tensor) -> torch.Tensor:
        return torch.full_like(like, 0.4)

    arguments = trained.places(), trained.natural()
    with torch.no_grad():
        noisy, apart, hard = (
            trained.chain(*arguments, noise=given, network_bits=8, everywhere=everywhere)
            for given, everywhere in ((noise, True), (noise, False), (None, False))
        )
    for group in GROUPS:
        assert torch.equal(apart.values[group], hard.values[group])
        assert not torch.equal(apart.values[group], noisy.values[group])
        assert not torch.equal(apart.bits[group], hard.bits[group])
    y = trained.natural()["feature"].detach() / trained.chain.step("feature").detach()
    torch.testing.assert_close(noisy.values["feature"], y + 0.4)


def test_an_anchors_own_bits_go_with_its_last_primitive(blob_scene: Scene) -> None:
    trainer = CosaTrainer(blob_scene, settings(position_bits=0.0), CPU, "cosa-gs")
    model = trainer.model
    n, k = model.anchors, 4
    bits = {group: torch.ones(n) for group in GROUPS} | {"offset": torch.full((n, k), 2.0)}
    masks = torch.ones(n, k)
    assert float(model.total_bits(bits, masks)) == pytest.approx(n * (4 + 8), rel=1e-3)
    masks[0] = 0  # nothing is left of it
    masks[1, 1:] = 0  # one primitive pays for all
    masks.requires_grad_()
    flags = model.total_bits(bits, masks).item() - ((n - 1) * 4 + 2 * masks.sum().item())
    assert flags == pytest.approx((n - 1) * k * _entropy(float(masks.detach().mean())), rel=1e-3)
    model.total_bits(bits, masks).backward()
    each = 4 + k * _entropy(float(masks.detach().mean()))
    assert masks.grad[1].tolist() == pytest.approx([2 + each, 2, 2, 2], rel=1e-3)
    assert masks.grad[2].tolist() == pytest.approx([2 + each / k] * k, rel=1e-3)


def test_a_position_costs_what_the_settings_say(blob_scene: Scene) -> None:
    totals = []
    for position_bits in (0.0, 12.5):
        model = CosaTrainer(blob_scene, settings(position_bits=position_bits), CPU, "cosa-gs").model
        bits = {group: torch.ones(model.anchors) for group in GROUPS}
        masks = torch.ones(model.anchors, 4)
        masks[:10] = 0  # these have none
        totals.append(model.total_bits({**bits, "offset": torch.ones(model.anchors, 4)}, masks).item())
    assert totals[1] - totals[0] == pytest.approx(12.5 * (model.anchors - 10), rel=1e-3)


def test_late_in_a_run_the_networks_compute_with_the_weights_of_the_file(blob_scene: Scene) -> None:
    trainer = CosaTrainer(blob_scene, settings(), CPU, "cosa-gs")
    for step, rounded in ((71, False), (72, True)):  # 80 % of 90
        trainer.step = step
        weight = (
            trainer.weights()["color_weight1"].detach() * 2**7
        )  # below 1/2: seven bits are so many whole numbers
        assert torch.equal(weight, weight.round()) == rounded
        assert 16 < weight.abs().max() < 64


def test_anchors_without_primitives_go_during_the_second_phase(blob_scene: Scene) -> None:
    trainer = CosaTrainer(blob_scene, settings(), CPU, "cosa-gs")
    trainer.step = trainer.rate_at
    trainer.train_step()
    before = trainer.model.anchors
    with torch.no_grad():
        trainer.model.mask_logits[:5] = -20.0
    while (trainer.step - trainer.rate_at) % trainer.schedule.every:
        assert trainer.model.anchors == before
        trainer.train_step()
    assert trainer.model.anchors <= before - 5


def _entropy(p: float) -> float:
    return -(p * np.log2(p) + (1 - p) * np.log2(1 - p))


def test_lambda_weighs_megabytes_of_the_whole_scene(blob_scene: Scene) -> None:
    trainer = CosaTrainer(blob_scene, settings(lmbda=3.0), CPU, "cosa-gs")
    trainer.train_step()
    torch.nn.init.normal_(trainer.model.latents, generator=torch.Generator().manual_seed(0))
    trainer.step = trainer.rate_at
    trainer.values()
    chained, masks = trainer.chained, trainer.masks
    assert chained is not None and masks is not None
    bits = trainer.model.total_bits(chained.bits, masks).item()
    added = trainer.added()
    assert added is not None and added.item() == pytest.approx(3.0 * bits / BITS_PER_MEGABYTE)
    added.backward()
    for name, parameter in trainer.model.named_parameters():
        costs = name.split(".")[0] in ("features", "offsets", "log_scales", "latents", "mask_logits", "chain")
        assert (parameter.grad is not None and parameter.grad.abs().sum() > 0) == costs, name


def test_a_larger_lambda_masks_more_primitives_and_drops_anchors(
    blob_scene: Scene, trained: CosaModel, file: Path, tmp_path: Path
) -> None:
    heavy = train(blob_scene, settings(lmbda=40.0), method="cosa-gs", device="cpu")
    assert heavy.mask.sum() < 0.8 * trained.mask.sum()
    assert heavy.anchors < trained.anchors
    assert heavy.mask.any(1).all(), "an anchor without primitives was kept"
    light = train(blob_scene, settings(lmbda=0.0), method="cosa-gs", device="cpu")
    assert light.mask.sum() > trained.mask.sum()
    assert write(heavy, tmp_path / "b", method="cosa-gs") < file.stat().st_size


@pytest.mark.parametrize("stop", [10, 30, 60])
def test_a_run_that_was_stopped_in_either_phase_gives_the_same_file(
    stop: int, blob_scene: Scene, trained: CosaModel, file: Path, tmp_path: Path
) -> None:
    def stopped(status: Any) -> None:
        if status.step == stop:
            raise KeyboardInterrupt

    run, again = tmp_path / "run", tmp_path / "b.packed"
    with pytest.raises(KeyboardInterrupt):
        train(blob_scene, settings(), method="cosa-gs", device="cpu", output=run, progress=stopped)
    for _ in range(2):  # a finished run gives the same once more
        model = train(blob_scene, settings(), method="cosa-gs", device="cpu", output=run, resume=True)
        write(model, again, method="cosa-gs")
        assert again.read_bytes() == file.read_bytes()


def test_what_has_diverged_is_not_written(blob_scene: Scene, tmp_path: Path) -> None:
    trainer = CosaTrainer(blob_scene, settings(), CPU, "cosa-gs")
    trainer.model.begin()
    with torch.no_grad():
        trainer.model.features[3, 2] = torch.nan
    with pytest.raises(NotEncodable, match="features"):
        write(trainer.model, tmp_path / "a", method="cosa-gs")
    with torch.no_grad():
        trainer.model.features[3, 2] = 1e6
    with pytest.raises(NotEncodable, match=r"a feature is .* steps from"):
        write(trainer.model, tmp_path / "a", method="cosa-gs")
    with torch.no_grad():
        trainer.model.features.zero_()
        trainer.model.mask_logits.fill_(-10.0)
    with pytest.raises(NotEncodable, match="masked"):
        write(trainer.model, tmp_path / "a", method="cosa-gs")
    assert not (tmp_path / "a").exists()


# damaged files ------------------------------------------------------------------------------------------------------


def with_array(content: packed.Packed, name: str, data: bytes) -> packed.Packed:
    return replace(content, arrays={**content.arrays, name: np.frombuffer(data, np.uint8)})


@pytest.fixture(scope="module")
def content(trained: CosaModel) -> packed.Packed:
    return packed_content(trained.content())


@pytest.mark.parametrize("name", ["positions", "context", "networks", "latents"])
def test_an_array_that_ends_early_or_goes_on_is_refused(name: str, content: packed.Packed) -> None:
    data = content.arrays[name].tobytes()
    # (an octree's last byte may be one that its decoder would have made up)
    shorter = data[: -9 if name == "positions" else -1]
    for damaged in (shorter, data[: len(data) // 2], b"", data + b"\0"):
        with pytest.raises(SplatFileError, match="copy it again"):
            reader.content_of(with_array(content, name, damaged))


@pytest.mark.parametrize("name", ["positions", "masks", "context", "networks", "latents"])
def test_flipped_bits_are_refused_or_another_scene_but_never_worse(name: str, content: packed.Packed) -> None:
    """The container's checksums tell; behind them, whatever the bytes are, nothing but our own errors comes."""
    data = content.arrays[name].tobytes()
    chance = np.random.default_rng(0)
    for _ in range(25):
        damaged = bytearray(data)
        damaged[chance.integers(len(data))] ^= 1 << int(chance.integers(8))
        try:
            found = reader.content_of(with_array(content, name, bytes(damaged)))
        except CompGSError as error:
            assert isinstance(error, SplatFileError)
        else:
            assert found.mask.shape == (len(found.coordinates), 4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("anchors", 0),
        ("anchors", 1 << 30),
        ("anchors", None),
        ("shape", [4, 8, 4]),
        ("shape", [65, 8, 4, 8]),
        ("shape", [4, 8, 4, 9]),
        ("shape", [4, 0, 4, 8]),
        ("steps", [1.0, 1.0, 1.0, 1.0, 0.0]),
        ("steps", "fine"),
        ("cube", [0, 0, 0, 22]),
        ("cube", [0, 0, 0, 1.5]),
        ("frame", [0.0] * 8),
        ("frame", [1.0] * 7),
    ],
)
def test_facts_that_no_encoder_writes_are_refused(name: str, value: Any, content: packed.Packed) -> None:
    facts = {**content.facts, name: value}
    with pytest.raises(SplatFileError, match=f"{name}|step or unit|context|networks"):
        reader.content_of(replace(content, facts={k: v for k, v in facts.items() if v is not None}))


def test_its_networks_are_not_exported(file: Path, tmp_path: Path) -> None:
    with pytest.raises(SplatFileError, match=r"a\.packed: its splats are made anew for each camera"):
        export(file, tmp_path / "a.ply")


def test_a_damaged_file_is_refused_by_its_checksum(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[-5] ^= 1
    file.write_bytes(data)
    with pytest.raises(SplatFileError, match="latents are damaged"):
        open_scene(file)
