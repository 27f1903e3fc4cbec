"""Prediction that waits for nothing: all primitives, those that are not drawn with opacity 0."""

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.losses import scale_regularizer
from compgs.model import HeadDimensions, HybridModel
from compgs.model.constants import OPACITY_CUTOFF
from compgs.render import rasterize as rasterize_arrays
from compgs.tensors import where
from compgs.tensors.heads import PredictionHeads, make_heads
from compgs.tensors.prediction import predict
from compgs.tensors.primitives import Primitives, every_slot
from compgs.tensors.rasterize import rasterize
from compgs.tensors.scenes import HybridOnDevice

N, K, D, G = 60, 5, 12, 8
CAMERA = Camera(np.eye(4), 30, 30, 16, 12, 32, 24)


def make(layout: str, dtype: torch.dtype) -> tuple[PredictionHeads, Primitives]:
    g = torch.Generator().manual_seed(1)
    torch.manual_seed(0)
    heads = make_heads(layout, HeadDimensions(D, G, 16)).to(dtype)
    positions, log_scales, references, residuals = (
        torch.randn(shape, generator=g).to(dtype) for shape in ((N, 3), (N, 6), (N, D), (N * K, G))
    )
    positions[:, 2] += 4
    for t in (log_scales, references, residuals):
        t.requires_grad_()
    return heads, Primitives(positions, log_scales, references, residuals, every_slot(N, K), 0.1)


def outcome(layout: str, compact: bool) -> list[torch.Tensor]:
    """Image, regularizer, opacities, and their gradients by everything that is trained."""
    heads, p = make(layout, torch.float64)
    center = torch.zeros(3, dtype=torch.float64)
    found = predict(heads, p, center, 4.0, compact=compact)
    image = rasterize(found.gaussians, CAMERA).image
    regularizer = scale_regularizer(found.gaussians.scales, found.drawn)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(2))
    ((image * weights).sum() + 100 * regularizer).backward()
    gradients = [p.log_scales.grad, p.references.grad, p.residuals.grad]
    return [image.detach(), regularizer.detach(), found.opacities.detach(), *gradients] + [
        w.grad for w in heads.parameters()
    ]


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_leaving_nothing_out_changes_neither_image_nor_gradients(layout):
    for found, expected in zip(outcome(layout, False), outcome(layout, True), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_a_decoded_scene_looks_the_same_where_nothing_is_left_out(monkeypatch, layout):
    heads, p = make(layout, torch.float32)
    model = HybridModel(p.arrays(), heads.weights(), 4.0, (0.0, 0.0, 0.0))
    chosen = model.gaussians(CAMERA)
    monkeypatch.setattr(where, "choosing_pays", lambda device: False)
    everything = HybridOnDevice.of(model, torch.device("cpu")).gaussians(CAMERA)
    assert len(everything) == N * K > len(chosen)
    a, b = rasterize_arrays(chosen, CAMERA).image, rasterize_arrays(everything, CAMERA).image
    np.testing.assert_allclose(a, b, atol=1e-5, rtol=0)


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_appearance_in_bfloat16_is_near_that_in_float32(layout):
    heads, p = make(layout, torch.float32)
    scene = p.arrays(), heads.weights(), 4.0, (0.0, 0.0, 0.0)
    exact = HybridModel(*scene).gaussians(CAMERA)
    rough = HybridOnDevice(*scene, appearance_dtype=torch.bfloat16).gaussians(CAMERA)
    for found in rough.opacities, rough.colors, rough.means:
        assert found.dtype == np.float32
    difference = np.abs(rasterize_arrays(exact, CAMERA).image - rasterize_arrays(rough, CAMERA).image)
    assert 0 < difference.max() < 0.05


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_masked_prediction_reads_no_value_back(layout):
    # Tensors on "meta" have shapes but no values: whatever needs a value fails.
    heads, p = make(layout, torch.float32)
    heads = heads.to("meta")
    moved = [
        getattr(p, name).detach().to("meta")
        for name in ("positions", "log_scales", "references", "residuals", "anchor_index")
    ]
    with pytest.raises((RuntimeError, NotImplementedError)):
        predict(heads, Primitives(*moved, 0.1), torch.zeros(3, device="meta"), 4.0)
    center = torch.zeros(3, device="meta")
    found = predict(heads, Primitives(*moved, 0.1), center, 4.0, compact=False)
    assert found.gaussians.means.shape == (N * K, 3)


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_what_is_not_drawn_has_an_opacity_of_exactly_0(layout):
    heads, p = make(layout, torch.float64)
    everything = predict(heads, p, torch.zeros(3, dtype=torch.float64), 4.0, compact=False)
    drawn = everything.opacities > OPACITY_CUTOFF
    assert torch.equal(everything.drawn, drawn) and 0 < drawn.sum() < N * K
    assert (everything.gaussians.opacities[~drawn] == 0).all()
    assert torch.equal(everything.gaussians.opacities[drawn], everything.opacities[drawn])
