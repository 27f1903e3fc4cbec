"""The size that a file would have, against files that are written."""

from dataclasses import replace

import pytest
import torch

from compgs.codec.encoder import to_content
from compgs.codec.reader import file_info
from compgs.codec.writer import write_content
from compgs.config import Config
from compgs.scene.views import Scene
from compgs.trained_model import TrainedModel
from compgs.training.file_size import fixed_bytes, latent_bytes
from compgs.training.initial import initial_model


@pytest.fixture
def model(blob_scene: Scene, tiny_config: Config) -> TrainedModel:
    """With latents of a few steps, and a mask that leaves some anchors nothing."""
    result = initial_model(blob_scene, tiny_config)
    chance = torch.Generator().manual_seed(0)
    with torch.no_grad():
        result.references += 3 * torch.randn(result.references.shape, generator=chance)
    result.mask = torch.rand(result.mask.shape, generator=chance) < 0.5
    return result


def test_an_anchor_that_has_primitives_left_takes_ten_bits_for_its_position(model: TrainedModel) -> None:
    left = int(model.mask.any(1).sum())
    assert left < model.anchors
    bits = sum(model.estimated_bits().values())
    assert latent_bytes(model) == pytest.approx((bits + 10 * left) / 8)


def test_the_cameras_that_a_file_keeps_are_counted(model: TrainedModel) -> None:
    estimates, files = [], []
    for kept in (0, 1, 8):
        model.config = replace(model.config, training=replace(model.config.training, viewpoints=kept))
        estimates.append(fixed_bytes(model))
        files.append(len(write_content(to_content(model))))
    assert files[0] < files[1] < files[2]
    for i in (1, 2):
        assert estimates[i] - estimates[0] == pytest.approx(files[i] - files[0], abs=20)


def test_the_networks_take_about_what_they_are_said_to(model: TrainedModel) -> None:
    written = {s.name: s.bytes for s in file_info(write_content(to_content(model))).sections}
    networks = sum(count for name, count in written.items() if "heads" in name or "networks" in name)
    assert fixed_bytes(model) == pytest.approx(networks + 600, rel=0.1)
