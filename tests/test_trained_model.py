"""Residual embeddings of a trained model: each anchor's own, or shared by all."""

from dataclasses import replace

import pytest
import torch

from compgs.config import Config, ModelConfig
from compgs.entropy.quantization import quantize_weight
from compgs.stored_weights import SHARED_RESIDUAL_BITS
from compgs.trained_model import OwnResiduals, SharedResiduals, TrainedModel

N, K, G, STEP = 6, 3, 2, 0.5


def made(*, own: bool) -> TrainedModel:
    torch.manual_seed(0)
    config = Config(model=ModelConfig(coupled_primitives=K, residual_dim=G, residuals=own))
    config = replace(config, entropy=replace(config.entropy, quantization_steps=(0.33, STEP, 0.15)))
    coordinates = torch.arange(3 * N, dtype=torch.int32).view(N, 3)
    model = TrainedModel(config, coordinates, 0.1, 1.0, (0.0, 0.0, 0.0))
    with torch.no_grad():
        model.residuals.normal_(0, 3, generator=torch.Generator().manual_seed(1))
    return model


def test_own_residuals_have_a_row_for_each_anchor_and_come_and_go_with_it() -> None:
    model = made(own=True)
    assert isinstance(model.residual_kind, OwnResiduals) and model.residuals.shape == (N, K * G)
    assert model.anchor_parameters == ("log_scales", "references", "residuals")
    rows = torch.tensor([1, 4])
    found = model.quantized(rows).residuals
    assert torch.equal(found, model.quantized().residuals[rows])
    assert (found - model.residuals[rows]).abs().max() <= 0.5


@pytest.mark.parametrize("stored", [True, False])
def test_shared_residuals_have_one_row_that_every_anchor_sees_as_the_file_holds_it(stored: bool) -> None:
    model = made(own=False)
    assert isinstance(model.residual_kind, SharedResiduals) and model.residuals.shape == (1, K * G)
    assert model.anchor_parameters == ("log_scales", "references")
    dequantized = model.residuals.view(K, G) * STEP
    assert torch.equal(model.shared_residuals(), dequantized)
    expected = quantize_weight(dequantized, SHARED_RESIDUAL_BITS) if stored else dequantized
    rows = torch.tensor([0, 3, 5])
    latents = model.quantized(rows, stored_weights=stored)
    assert latents.residuals.shape == (3, K * G)
    seen = model.primitives(latents, rows).residuals
    torch.testing.assert_close(seen, expected.repeat(3, 1))
    if stored:
        assert not torch.equal(expected, dequantized)


def test_the_parameters_of_both_kinds_have_the_name_that_checkpoints_hold() -> None:
    assert all("residuals" in dict(made(own=own).named_parameters()) for own in (True, False))


@pytest.mark.parametrize("own", [True, False])
def test_the_heads_section_holds_residuals_only_where_all_anchors_share_them(own: bool) -> None:
    model = made(own=own)
    networks = dict(model.heads.named_parameters())
    tensors = model.head_tensors()
    assert tensors.keys() - networks.keys() == (set() if own else {"residuals"})
    if not own:
        assert torch.equal(tensors["residuals"], model.shared_residuals())
