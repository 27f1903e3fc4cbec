"""A model that renders block by block, with anchors that have any number of coupled primitives, or none."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from compgs.cameras import Camera
from compgs.model import (
    HeadDimensions,
    HybridModel,
    Primitives,
    hybrid_model,
    inference,
    make_heads,
    predict,
)
from compgs.model.primitives import select_anchors

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
    return HybridModel(primitives, make_heads(layout, HeadDimensions(D, G, 16)), 4.0, (0.0, 0.0, 0.0))


def in_precision(model: HybridModel, dtype: torch.dtype) -> HybridModel:
    p = model.primitives
    names = ("positions", "log_scales", "references", "residuals")
    primitives = replace(p, **{name: getattr(p, name).to(dtype) for name in names})
    return replace(model, primitives=primitives, heads=model.heads.to(dtype))


@pytest.fixture
def counts() -> torch.Tensor:
    counts = torch.randint(0, 5, (N,), generator=torch.Generator().manual_seed(4))
    counts[0] = counts[17] = counts[-1] = 0
    return counts


@pytest.mark.parametrize("layout", ["paired", "separate"])
@pytest.mark.parametrize("block", [1, 7, 8, 1 << 14])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["by kernels", "by torch"])
def test_every_block_size_gives_the_gaussians_of_prediction(monkeypatch, counts, layout, block, dtype):
    monkeypatch.setattr(hybrid_model, "BLOCK", block)
    monkeypatch.setattr(inference, "BLOCK", block)
    model = in_precision(make_model(layout, counts), dtype)
    visible = torch.rand(N, generator=torch.Generator().manual_seed(5)) < 0.6
    everything = torch.ones(N, dtype=torch.bool)
    for mask, found in (
        (visible, model.gaussians(CAMERA, visible)),
        (everything, model.gaussians(CAMERA, everything)),
        (everything, model.gaussians(CAMERA)),
    ):
        chosen = select_anchors(model.primitives, mask)
        expected = predict(model.heads, chosen, torch.zeros(3, dtype=dtype), 4.0).gaussians
        assert len(found.means) > 5
        for name in FIELDS:
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("block", [8, 1 << 14])
def test_bounds_are_the_farthest_reach_of_each_anchors_primitives(monkeypatch, counts, block):
    monkeypatch.setattr(hybrid_model, "BLOCK", block)
    model = make_model("paired", counts)
    means, scales, _ = model.geometry
    centers, radii = model.bounds
    for i in range(N):
        own = model.primitives.anchor_index == i
        reach = (means[own] - centers[i]).norm(dim=1) + hybrid_model.CUTOFF_SIGMAS * scales[own].amax(1)
        torch.testing.assert_close(radii[i], reach.max() if own.any() else torch.tensor(0.0))


@pytest.mark.parametrize("layout", ["paired", "separate"])
def test_nothing_in_view_is_no_gaussians(counts, layout):
    model = make_model(layout, counts)
    nothing = model.gaussians(CAMERA, torch.zeros(N, dtype=torch.bool))
    bare = make_model(layout, torch.zeros(N, dtype=torch.int64))
    for gaussians in (nothing, bare.gaussians(CAMERA)):
        assert [len(getattr(gaussians, name)) for name in FIELDS] == [0] * 5
    assert (bare.bounds[1] == 0).all()


def test_anchors_out_of_view_change_nothing(counts):
    model = make_model("paired", counts)
    visible = torch.arange(N) % 3 > 0
    shaken = model.primitives.residuals + 10 * (~visible)[model.primitives.anchor_index, None]
    other = replace(model, primitives=replace(model.primitives, residuals=shaken))
    for name in ("opacities", "colors", "means"):
        a, b = (getattr(m.gaussians(CAMERA, visible), name) for m in (model, other))
        assert torch.equal(a, b)


@pytest.mark.parametrize("layout", ["paired", "separate"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["by kernels", "by torch"])
def test_what_is_drawn_is_named_by_its_row_among_all_primitives(monkeypatch, counts, layout, dtype):
    monkeypatch.setattr(hybrid_model, "BLOCK", 7)
    model = in_precision(make_model(layout, counts), dtype)
    visible = torch.arange(N) % 3 > 0
    found, index = model.drawn(CAMERA, visible)
    everything = predict(model.heads, model.primitives, torch.zeros(3, dtype=dtype), 4.0)
    seen = everything.index[visible[model.primitives.anchor_index[everything.index]]]
    assert torch.equal(index, seen) and 5 < len(index) < len(everything.index)
    torch.testing.assert_close(found.means, model.geometry[0][index])
