"""The size that a file would have, against files that are written."""

import math
from dataclasses import replace

import pytest
import torch

from compgs.codec.encoder import to_content
from compgs.codec.reader import file_info
from compgs.codec.writer import write_content
from compgs.config import Config
from compgs.scene.views import Scene
from compgs.trained_model import TrainedModel
from compgs.training.rate.file_size import FileSize, anchor_bits, fixed_bytes
from compgs.training.start import initial_model
from compgs.training.trainer import Trainer


@pytest.fixture
def model(blob_scene: Scene, tiny_config: Config) -> TrainedModel:
    """With latents of a few steps, and a mask that leaves some anchors nothing."""
    result = initial_model(blob_scene, tiny_config)
    chance = torch.Generator().manual_seed(0)
    with torch.no_grad():
        result.references += 3 * torch.randn(result.references.shape, generator=chance)
    result.mask = torch.rand(result.mask.shape, generator=chance) < 0.5
    return result


def written(model: TrainedModel) -> dict[str, int]:
    """Bytes of the file's sections, by name."""
    return {section.name: section.bytes for section in file_info(write_content(to_content(model))).sections}


def test_positions_and_masks_take_what_their_coders_say(model: TrainedModel) -> None:
    assert int(model.mask.any(1).sum()) < model.anchors
    latents = sum(model.estimated_bits().values()) / 8
    sections = written(model)
    assert FileSize(model).latents() == pytest.approx(
        latents + sections["positions"] + sections["masks"], abs=0.01
    )


def test_positions_are_coded_anew_where_anchors_change(model: TrainedModel) -> None:
    model.mask = torch.ones_like(model.mask)
    size = FileSize(model)
    before = size.latents()
    assert size.latents() == before
    bits = sum(model.estimated_bits().values()) / 8
    model.coordinates = model.coordinates * 7  # no grid that the coder knows
    assert size.latents() == pytest.approx(bits + written(model)["positions"], abs=0.01)
    assert size.latents() > before


def test_without_primitives_there_is_nothing(model: TrainedModel) -> None:
    assert FileSize(model).latents(torch.zeros_like(model.mask)) == 0


def test_the_cameras_that_a_file_keeps_are_counted(model: TrainedModel) -> None:
    estimates, files = [], []
    for kept in (0, 1, 3):
        model.most_viewpoints = kept
        estimates.append(fixed_bytes(model))
        files.append(len(write_content(to_content(model))))
    assert files[0] < files[1] < files[2]
    for i in (1, 2):
        assert estimates[i] - estimates[0] == pytest.approx(files[i] - files[0], abs=20)


def test_the_networks_take_about_what_they_are_said_to(model: TrainedModel) -> None:
    networks = sum(count for name, count in written(model).items() if "heads" in name or "networks" in name)
    assert fixed_bytes(model) == pytest.approx(networks + 350, rel=0.1)


def test_a_written_file_takes_its_share_of_what_training_pays_for(model: TrainedModel) -> None:
    """Less than all of it where the symbols of an anchor go together, as here the log scales do."""
    with torch.no_grad():
        model.log_scales += 2 * torch.randn(len(model.log_scales), 1)
    size = FileSize(model)
    share = size.written_share()
    assert share < 0.97
    expected = share * size.latents() + fixed_bytes(model)
    assert expected == pytest.approx(len(write_content(to_content(model))), abs=1)


def test_the_last_pruning_leaves_three_percent_more_than_the_size_at_most_and_earlier_ones_any_number(
    blob_scene: Scene, tiny_config: Config
) -> None:
    config = replace(tiny_config, training=replace(tiny_config.training, target_bytes=60_000))
    structure = Trainer(blob_scene, config, torch.device("cpu")).structure
    bits = anchor_bits(structure.model)
    last = max(structure.pruned_at)
    least, most = structure.target_size.bits_to_keep(last, bits, 1.0)
    assert 0 < least < math.inf and most == pytest.approx(1.03 * least)
    assert structure.target_size.bits_to_keep(last - 1, bits, 1.0) == (pytest.approx(least), math.inf)
