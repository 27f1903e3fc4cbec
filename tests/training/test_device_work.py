"""How often the CPU reads values of tensors, each of which waits for a GPU, and what is not computed again."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from compgs.entropy import neighbourhood as neighbours
from compgs.entropy.quantization import WeightRounding, quantize_weight, quantize_weights
from compgs.tensors import where
from compgs.training.rate.file_size import fixed_bytes
from compgs.training.run.shown_size import ShownSize
from compgs.training.step import pictures
from compgs.training.trainer import Trainer

from .test_waiting import rasterize_nothing

CPU = torch.device("cpu")
READS = {"item", "tolist", "cpu", "numpy", "__bool__", "__float__", "__int__", "__index__", "nonzero"}


class Reads(TorchFunctionMode):
    """Counts what makes values of tensors known to the CPU."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_function__(self, function, types, args=(), kwargs=None):
        self.count += getattr(function, "__name__", "") in READS
        return function(*args, **(kwargs or {}))


class Operations(TorchDispatchMode):
    """How many operations there were, but for those that only look at a tensor in another way, and the most numbers
    that one has given.
    """

    def __init__(self) -> None:
        super().__init__()
        self.count = self.numbers = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        found = function(*args, **(kwargs or {}))
        views = (
            each.alias_info is not None and not each.alias_info.is_write for each in function._schema.returns
        )
        self.count += not any(views)
        for each in found if isinstance(found, tuple) else (found,):
            self.numbers = max(self.numbers, each.numel() if isinstance(each, Tensor) else 0)
        return found


@pytest.fixture
def trainer(blob_scene, tiny_config) -> Trainer:
    return Trainer(blob_scene, tiny_config, CPU)


@pytest.fixture
def roundings(monkeypatch) -> list[int]:
    """The numbers that have been rounded at once, each time."""
    found: list[int] = []
    rounding_of = WeightRounding.of

    def counted(weights, bits) -> WeightRounding:
        found.append(sum(weight.numel() for weight in weights))
        return rounding_of(weights, bits)

    monkeypatch.setattr(WeightRounding, "of", staticmethod(counted))
    return found


def test_the_size_of_the_networks_is_known_after_one_read(trainer) -> None:
    with Reads() as reads:
        fixed_bytes(trainer.model)
    assert reads.count == 1


def test_an_estimate_of_the_files_size_reads_five_times_at_most(trainer, monkeypatch) -> None:
    monkeypatch.setattr(
        where, "in_kernels", lambda *tensors: False
    )  # the kernels read all that they compute with
    trainer.estimated_bytes()  # positions are coded, and remembered while anchors stay the same
    with Reads() as reads:
        trainer.estimated_bytes()
    assert 0 < reads.count <= 5


def test_estimates_take_a_fiftieth_of_a_run() -> None:
    now, estimates = [0.0], []

    def estimated_bytes() -> int:
        now[0] += 0.25
        estimates.append(now[0])
        return len(estimates)

    size = ShownSize(estimated_bytes, lambda: now[0])
    for _ in range(10_000):  # steps of 10 ms
        now[0] += 0.01
        size.look(last=False)
    assert 0.25 * len(estimates) == pytest.approx(now[0] / 50, rel=0.2)
    shown = size.bytes
    assert size.look(last=True) > 0 and size.bytes == shown + 1


def test_several_weights_are_rounded_as_each_by_itself() -> None:
    chance = torch.Generator().manual_seed(1)
    weights = [torch.randn(shape, generator=chance) * size for shape, size in SHAPES]
    weights[2][:] = 0
    bits = [7, 8, 12, 5, 16]
    found = quantize_weights(weights, bits)
    for weight, count, stored in zip(weights, bits, found, strict=True):
        assert torch.equal(stored, quantize_weight(weight, count))


SHAPES = (((3, 4), 1.0), ((5,), 0.01), ((2, 2, 2), 1.0), ((7,), 300.0), ((1, 9), 1e-9))


def test_gradients_pass_several_weights_as_if_nothing_had_happened() -> None:
    weights = [torch.randn(2, 3, requires_grad=True), torch.randn(4, requires_grad=True)]
    first, second = WeightRounding.of(weights, [7, 7]).applied(weights)
    (2 * first.sum() + (second * torch.arange(4.0)).sum()).backward()
    assert torch.equal(weights[0].grad, torch.full((2, 3), 2.0))
    assert torch.equal(weights[1].grad, torch.arange(4.0))


def test_weights_are_rounded_once_a_step_and_anew_in_the_next(blob_scene, tiny_config, roundings) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, views_per_step=4))
    trainer = Trainer(blob_scene, config, CPU)
    trainer.step = 36  # networks compute with weights as stored
    before = trainer.model.stored_head_weights()
    roundings.clear()
    trainer.train_step()
    assert len(roundings) == 1
    after = trainer.model.stored_head_weights()
    assert len(roundings) == 2 and any(not torch.equal(after[name], before[name]) for name in before)


def test_a_survey_of_all_views_rounds_weights_once(trainer, roundings) -> None:
    trainer.survey.contributions()
    trainer.survey.changes()
    assert len(roundings) == 2


def test_neighbours_are_summed_without_a_copy_of_each(monkeypatch) -> None:
    monkeypatch.setattr(where, "in_kernels", lambda *tensors: False)
    chance = torch.Generator().manual_seed(2)
    coordinates = torch.unique(torch.randint(0, 40, (4_000, 3), generator=chance), dim=0).to(torch.int32)
    found = neighbours.neighbourhood(coordinates)
    latents, rows = torch.randn(len(coordinates), 32, generator=chance), torch.arange(0, len(coordinates), 2)
    assert found.anchors.shape[1] > 4
    with Operations() as operations:
        found.around(latents, torch.zeros(32), rows)
    assert operations.numbers == len(coordinates) * (32 + 2), "what each anchor says, once"


@pytest.mark.parametrize("views", [1, 4])
def test_a_step_with_rounded_weights_has_few_operations_more(
    blob_scene, tiny_config, monkeypatch, views
) -> None:
    """Each of 18 weights by itself would take some thirty in each view."""
    monkeypatch.setattr(where, "in_kernels", lambda *tensors: False)
    monkeypatch.setattr(where, "runs_in_kernels", lambda device, *dtypes: False)
    monkeypatch.setattr(where, "choosing_pays", lambda device: False)
    monkeypatch.setattr(pictures, "rasterize", rasterize_nothing)
    config = replace(tiny_config, training=replace(tiny_config.training, views_per_step=views))
    trainer = Trainer(blob_scene, config, CPU)
    counts = {}
    for step in (29, 33):  # the second with weights as stored; nothing else is due
        for _ in range(2):
            trainer.step = step
            with Operations() as operations:
                trainer.train_step()
        counts[step] = operations.count
    assert trainer.config.training.borders.weights == 32 / 40
    assert 0 < counts[33] - counts[29] < 120 + 40 * views
