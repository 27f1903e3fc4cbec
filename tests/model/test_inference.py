"""The way from anchors in view to Gaussians by kernels on arrays, against plain torch in float64."""

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.model import HeadDimensions, HybridModel, hybrid_model, inference
from compgs.model.network_kernels import ANCHORS, ROWS
from compgs.tensors.heads import make_heads
from compgs.tensors.prediction import Prediction, predict
from compgs.tensors.primitives import Primitives, select_anchors
from compgs.tensors.scenes import HybridOnDevice

N, D, G = 3 * ANCHORS + 17, 12, 8
FIELDS = ("means", "quaternions", "scales", "opacities", "colors")
POSE = np.eye(4)
POSE[:3, 3] = (0.3, -1.0, 2.0)
CAMERA = Camera(POSE, 50, 50, 32, 32, 64, 64)


def make_model(
    counts: torch.Tensor,  # [N] coupled primitives of each anchor
    positions: torch.Tensor | None = None,
    layout: str = "paired",
) -> HybridModel:
    g = torch.Generator().manual_seed(3)
    torch.manual_seed(0)
    n = len(counts)
    primitives = Primitives(
        positions=3 * torch.randn(n, 3, generator=g) if positions is None else positions,
        log_scales=torch.randn(n, 6, generator=g),
        references=torch.randn(n, D, generator=g),
        residuals=torch.randn(int(counts.sum()), G, generator=g),
        anchor_index=torch.repeat_interleave(counts),
        voxel_size=0.05,
    )
    heads = make_heads(layout, HeadDimensions(D, G, 16))
    return HybridModel(primitives.arrays(), heads.weights(), 4.0, (0.0, 0.0, 0.0))


def wide(model: HybridModel) -> HybridOnDevice:
    """The same in float64, by torch."""
    names = ("primitives", "heads", "distance_unit", "background")
    return HybridOnDevice(*(getattr(model, name) for name in names), dtype=torch.float64)


def truth(model: HybridModel, visible: torch.Tensor, layout: str) -> Prediction:
    exact = wide(model)
    seen = select_anchors(exact.primitive_tensors, visible)
    return predict(exact.networks, seen, torch.tensor(CAMERA.center), model.distance_unit)


def counts_with(*special: int) -> torch.Tensor:
    counts = torch.randint(0, 6, (N,), generator=torch.Generator().manual_seed(4))
    counts[: len(special)] = torch.tensor(special)
    counts[-1] = special[0]
    return counts


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
@pytest.mark.parametrize("special", [(0, 0, 1), (ROWS, 0, ROWS - 1), (3 * ROWS + 1, ROWS + 1)])
@pytest.mark.parametrize("share", [0.02, 0.6, 1.0])
def test_gaussians_agree_with_float64_whatever_the_number_of_primitives(special, share, layout):
    model = make_model(counts_with(*special), layout=layout)
    visible = torch.rand(N, generator=torch.Generator().manual_seed(5)) < share
    found, index = model.drawn(CAMERA, visible.numpy())
    expected = truth(model, visible, layout)
    # Rows of the primitives of visible anchors, in all and one after the other.
    rows = np.flatnonzero(visible[model.primitives.anchor_index])
    assert np.array_equal(index, rows[expected.index])
    assert len(found) > 0
    for name in FIELDS:
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected.gaussians, name), atol=2e-6, rtol=1e-5
        )


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
@pytest.mark.parametrize("block", [1, ANCHORS, ANCHORS + 1])
def test_geometry_is_the_same_in_blocks_of_any_size(monkeypatch, layout, block):
    model = make_model(counts_with(ROWS, 0, 3), layout=layout)
    monkeypatch.setattr(inference, "BLOCK", block)
    expected = wide(model).geometry
    for found, exact in zip(model.geometry, expected, strict=True):
        np.testing.assert_allclose(found, exact, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
def test_parts_of_a_frame_together_are_the_frame(monkeypatch, layout):
    model = make_model(counts_with(ROWS, 0, 3), layout=layout)
    whole = model.gaussians(CAMERA)
    monkeypatch.setattr(hybrid_model, "FRAME_BLOCK", ANCHORS)
    parts = list(model.parts(CAMERA))
    assert len(parts) == 4
    for name in FIELDS:
        assert np.array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
def test_an_anchor_at_the_camera_has_finite_colors(layout):
    center = torch.tensor(CAMERA.center, dtype=torch.float32)
    model = make_model(torch.full((3,), 5), positions=center.repeat(3, 1), layout=layout)
    assert np.isfinite(model.gaussians(CAMERA).colors).all()


def test_gaussians_do_not_depend_on_the_number_of_threads(with_threads):
    model = make_model(counts_with(200, 3))
    with_threads(2)
    two = model.gaussians(CAMERA)
    with_threads(1)
    one = model.gaussians(CAMERA)
    for name in FIELDS:
        assert np.array_equal(getattr(one, name), getattr(two, name))
