"""A model that renders block by block, with anchors that have any number of coupled primitives, or none."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.model import HeadDimensions, HybridModel, hybrid_model, inference
from compgs.tensors import scenes
from compgs.tensors.heads import make_heads
from compgs.tensors.prediction import predict
from compgs.tensors.primitives import Primitives, select_anchors
from compgs.tensors.scenes import HybridOnDevice

N, D, G = 40, 12, 8
FIELDS = ("means", "quaternions", "scales", "opacities", "colors")
CAMERA = Camera(np.eye(4), 50, 50, 32, 32, 64, 64)


def make_model(
    layout: str, counts: torch.Tensor
) -> HybridModel:  # counts: [N] coupled primitives of each anchor
    g = torch.Generator().manual_seed(3)
    torch.manual_seed(0)
    primitives = Primitives(
        positions=torch.randn(len(counts), 3, generator=g) * 3,
        log_scales=torch.randn(len(counts), 6, generator=g),
        references=torch.randn(len(counts), D, generator=g),
        residuals=torch.randn(int(counts.sum()), G, generator=g),
        anchor_index=torch.repeat_interleave(counts),
        voxel_size=0.05,
    )
    heads = make_heads(layout, HeadDimensions(D, G, 16))
    return HybridModel(primitives.arrays(), heads.weights(), 4.0, (0.0, 0.0, 0.0))


def on_device(model: HybridModel, dtype: torch.dtype) -> HybridOnDevice:
    """The same by torch."""
    return replace(HybridOnDevice.of(model, torch.device("cpu")), dtype=dtype)


def in_precision(model: HybridModel, dtype: torch.dtype) -> HybridModel:
    return model if dtype == torch.float32 else on_device(model, dtype)


@pytest.fixture
def counts() -> torch.Tensor:
    counts = torch.randint(0, 5, (N,), generator=torch.Generator().manual_seed(4))
    counts[0] = counts[17] = counts[-1] = 0
    return counts


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
@pytest.mark.parametrize("block", [1, 7, 8, 1 << 14])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["by kernels", "by torch"])
def test_every_block_size_gives_the_gaussians_of_prediction(monkeypatch, counts, layout, block, dtype):
    monkeypatch.setattr(hybrid_model, "BLOCK", block)
    monkeypatch.setattr(inference, "BLOCK", block)
    monkeypatch.setattr(scenes, "BLOCK", block)
    model = in_precision(make_model(layout, counts), dtype)
    torched = on_device(model, dtype)
    visible = np.random.default_rng(5).random(N) < 0.6
    everything = np.ones(N, np.bool_)
    for mask, found in (
        (visible, model.gaussians(CAMERA, visible)),
        (everything, model.gaussians(CAMERA, everything)),
        (everything, model.gaussians(CAMERA)),
    ):
        chosen = select_anchors(torched.primitive_tensors, torch.from_numpy(mask))
        expected = predict(torched.networks, chosen, torch.zeros(3, dtype=dtype), 4.0).gaussians
        assert len(found.means) > 5
        for name in FIELDS:
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("block", [8, 1 << 14])
def test_bounds_are_the_farthest_reach_of_each_anchors_primitives(monkeypatch, counts, block):
    monkeypatch.setattr(hybrid_model, "BLOCK", block)
    model = make_model("paired", counts)
    means, scales, _ = model.geometry
    centers, radii = model.bounds
    for i in range(N):
        own = model.primitives.anchor_index == i
        if own.any():
            offset = np.linalg.norm(means[own] - centers[i], axis=1)
            reach = offset + hybrid_model.CUTOFF_SIGMAS * scales[own].max(1)
            assert radii[i] == pytest.approx(reach.max(), rel=1e-6)
        else:
            assert radii[i] == 0


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
def test_nothing_in_view_is_no_gaussians(counts, layout):
    model = make_model(layout, counts)
    nothing = model.gaussians(CAMERA, np.zeros(N, np.bool_))
    bare = make_model(layout, torch.zeros(N, dtype=torch.int64))
    for gaussians in (nothing, bare.gaussians(CAMERA)):
        assert [len(getattr(gaussians, name)) for name in FIELDS] == [0] * 5
    assert (bare.bounds[1] == 0).all()


def test_anchors_out_of_view_change_nothing(counts):
    model = make_model("paired", counts)
    visible = np.arange(N) % 3 > 0
    shaken = model.primitives.residuals + 10 * (~visible)[model.primitives.anchor_index, None]
    other = replace(model, primitives=replace(model.primitives, residuals=shaken.astype(np.float32)))
    for name in ("opacities", "colors", "means"):
        a, b = (getattr(m.gaussians(CAMERA, visible), name) for m in (model, other))
        assert np.array_equal(a, b)


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["by kernels", "by torch"])
def test_what_is_drawn_is_named_by_its_row_among_all_primitives(monkeypatch, counts, layout, dtype):
    monkeypatch.setattr(hybrid_model, "BLOCK", 7)
    monkeypatch.setattr(scenes, "BLOCK", 7)
    model = in_precision(make_model(layout, counts), dtype)
    torched = on_device(model, dtype)
    visible = np.arange(N) % 3 > 0
    found, index = model.drawn(CAMERA, visible)
    everything = predict(torched.networks, torched.primitive_tensors, torch.zeros(3, dtype=dtype), 4.0)
    seen = everything.index[visible[model.primitives.anchor_index[everything.index]]]
    assert np.array_equal(index, seen) and 5 < len(index) < len(everything.index)
    np.testing.assert_allclose(found.means, model.geometry[0][index], rtol=1e-6)


def test_bounds_are_the_same_on_every_device(counts):
    model = make_model("paired", counts)
    for found, exact in zip(model.bounds, on_device(model, torch.float64).bounds, strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-5)
