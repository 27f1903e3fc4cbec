"""A size asked for: the controller against made-up scenes, and real files of a tiny scene."""

import math
from dataclasses import replace

import pytest
import torch

from compgs.codec import encode
from compgs.errors import ConfigError
from compgs.training.rate.file_size import FileSize
from compgs.training.rate.rate_control import HIGHEST, LOWEST, RateState, due, follow
from compgs.training.rate.target_size import TargetSize
from compgs.training.start import initial_model
from compgs.training.structure.control import make_schedule
from compgs.training.trainer import Trainer

CPU = torch.device("cpu")
STEPS = 1000


def made_up_run(target: float, g: float, settling: float, lmbda: float = 0.001) -> tuple[float, float]:
    """(size, lambda) after a run whose size moves towards 100 kB (lambda / 0.001)^-g, the faster the shorter
    `settling` (of the run) is; half of it comes by growth, and later steps move it less.
    """
    state, log_size = RateState(lmbda), math.log(200e3)
    for step in range(1, STEPS + 1):
        progress = step / STEPS
        here = 100e3 * min(1.0, 0.5 + progress) * (state.lmbda / 0.001) ** -g
        log_size += (math.log(here) - log_size) / (settling * STEPS) * math.exp(-2 * progress)
        if due(step, STEPS, 0.1):
            state = follow(state, math.exp(log_size), target, progress=progress, grown=progress >= 0.5)
    return math.exp(log_size), state.lmbda


@pytest.mark.parametrize("g", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("settling", [0.02, 0.05])
@pytest.mark.parametrize("target", [70e3, 100e3, 130e3])
def test_the_size_is_reached_however_strongly_it_answers_to_lambda(
    target: float, settling: float, g: float
) -> None:
    assert made_up_run(target, g, settling)[0] == pytest.approx(target, rel=0.03)


@pytest.mark.parametrize(
    ("before", "ratio", "progress", "grown", "change"),
    [
        (None, 1.1, 0.6, True, 2 * math.log(1.1)),
        (None, 1.1, 0.96, True, math.log(1.1)),  # on the way from 0.92 to the end: half
        (0.02, 1.01, 0.6, True, 2 * math.log(1.01) + 15 * (math.log(1.01) - 0.02)),
        (0.02, 1.01, 1.0, True, 15 * (math.log(1.01) - 0.02)),
        (None, 1.5, 0.3, False, 0.2 * (math.log(1.5) - 0.1)),
        (None, 1.05, 0.3, False, 0.2 * (math.log(1.05) - 0.1)),  # it will shrink by itself
        (None, 9.0, 0.6, True, math.log(1.6)),
        (None, 1 / 9, 0.6, True, -math.log(1.6)),
    ],
)
def test_lambda_moves_by_the_formula(
    before: float | None, ratio: float, progress: float, grown: bool, change: float
) -> None:
    state = RateState(0.01, before, 0.7)
    after = follow(state, ratio * 5000, 5000, progress=progress, grown=grown)
    assert math.log(after.lmbda / 0.01) == pytest.approx(change)
    assert after.share == 0.7
    # A twentieth of the way, in the logarithm: two hundredths of a run undo each other.
    assert math.log(after.lmbda_of_pruning / 0.01) == pytest.approx(change / 20)
    assert RateState(0.01).lmbda_of_pruning == 0.01
    assert after.error == (pytest.approx(math.log(ratio)) if grown else before)


def test_the_share_that_is_left_is_that_of_all_prunings_to_come(blob_scene, tiny_config):
    """Each further pruning counts as a fifth of lambda more, and the file then has no idle primitives."""
    control = replace(tiny_config.control, prune_worth=20.0, idle_share=0.05)
    model = initial_model(blob_scene, replace(tiny_config, control=control))
    chance = torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.references += 3 * torch.randn(model.references.shape, generator=chance)
    weights = torch.rand(model.anchors, 4, generator=chance, dtype=torch.float64) ** 3
    changes = torch.rand(model.anchors, generator=chance, dtype=torch.float64)
    size = TargetSize(
        model, make_schedule(control, 40, 8), frozenset({10, 20}),
        contributions=lambda: weights, changes=lambda: changes, discount=0.0,
    )  # fmt: skip
    with torch.no_grad():
        streams = model.quantized(rate=True, mask=model.mask).bits.values()
    worth = 20 * changes / (sum(stream.double() for stream in streams) + 10)
    ascending = worth.sort().values[model.anchors // 5 :]
    lmbda = float(ascending[0] + ascending[1]) / 2 * model.anchors * 132 / 5
    flat = weights.view(-1).sort(descending=True)
    idle = flat.values[int((flat.values.cumsum(0) < 0.95 * weights.sum()).sum())]
    before = FileSize(model).latents()
    found = {}
    for step, dearer in ((5, 1.2), (10, 1.2), (11, 1.0), (21, 0.0)):
        found[step] = size.lasting_share(lmbda, step)
        assert model.mask.all(), "the model is as it was"
        kept = worth >= lmbda * dearer * 5 / 132 / model.anchors
        model.mask = kept[:, None] & (weights >= idle)
        expected = FileSize(model).latents() / before
        model.mask = torch.ones_like(model.mask)
        assert found[step] == pytest.approx(expected, rel=0.005), step
    assert found[5] == found[10] < 0.98 * found[11] < 0.8 * found[21] < 0.8


@pytest.mark.parametrize(("target", "limit"), [(1e3, HIGHEST), (1e7, LOWEST)])
def test_out_of_reach_lambda_stays_at_its_limit(target: float, limit: float) -> None:
    assert made_up_run(target, 0.2, 0.02)[1] == pytest.approx(limit, rel=0.01)


@pytest.fixture
def longer(tiny_config):
    return replace(
        tiny_config,
        control=replace(tiny_config.control, stop=0.5),
        training=replace(tiny_config.training, steps=300),
    )


@pytest.mark.parametrize("target", [4600, pytest.param(5100, marks=pytest.mark.slow)])
def test_one_training_gives_a_file_of_the_size_that_was_asked_for(blob_scene, longer, tmp_path, target):
    config = replace(longer, training=replace(longer.training, target_bytes=target))
    trainer = Trainer(blob_scene, config, CPU)
    trainer.run(None, None)
    assert encode(trainer.model, tmp_path / "a.cgs").bytes == pytest.approx(target, rel=0.05)


@pytest.mark.slow
def test_a_run_that_seeks_a_size_continues_exactly_and_needs_no_display(blob_scene, tiny_config, tmp_path):
    config = replace(tiny_config, training=replace(tiny_config.training, target_bytes=6000))
    whole = Trainer(blob_scene, config, CPU)
    whole.run(None, lambda status: None)
    for stop in (15, 31):
        first = Trainer(blob_scene, config, CPU)
        for _ in range(stop):
            first.train_step()
        first.save(tmp_path / "checkpoint.safetensors")
        second = Trainer.resumed(blob_scene, tmp_path / "checkpoint.safetensors", config, CPU)
        second.run(None, None)
        assert second.rate == whole.rate != RateState(config.training.lmbda)
        for name, value in second.model.state_dict().items():
            assert torch.equal(value, whole.model.state_dict()[name]), name


def test_a_size_below_that_of_the_networks_is_refused_before_any_step(blob_scene, tiny_config):
    config = replace(tiny_config, training=replace(tiny_config.training, target_bytes=2000))
    with pytest.raises(ConfigError, match=r"target_bytes = 2000: the networks alone"):
        Trainer(blob_scene, config, CPU)
