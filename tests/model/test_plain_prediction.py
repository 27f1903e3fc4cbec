"""The prediction against a program that was written from docs/bitstream_prediction.md alone."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.codec.content import Dimensions
from compgs.codec.decoder import decode
from compgs.codec.reader import read_latents
from compgs.codec.writer import write_content
from compgs.gaussians import Gaussians
from compgs.model import HeadDimensions, HeadWeights, HybridModel, PrimitiveArrays
from compgs.model.constants import OPACITY_CUTOFF
from compgs.tensors.heads import make_heads as new_heads
from compgs.tensors.prediction import predict
from compgs.tensors.scenes import HybridOnDevice

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "tools"), str(ROOT / "benchmarks")]
from made_content import make_content, make_dimensions, paper_groups  # noqa: E402
from made_heads import head_shapes, make_heads  # noqa: E402
from make_golden_gaussians import plain_content  # noqa: E402
from plain_prediction import (  # noqa: E402
    CUTOFF,
    Arrays,
    Content,
    Primitive,
    drawn,
    primitives,
    stacked,
    tolerances,
)
from prediction_precision import FIELDS, camera_at  # noqa: E402

CENTER = (0.5, -1.25, 2.0)
# (K, channels of references and residuals, layout, width)
SIZES = {
    "paired": (4, 6, 3, "paired", 8),
    "separate": (4, 6, 3, "separate", 8),
    "shallow": (4, 6, 3, "shallow", 8),
    "one slot": (1, 1, 1, "paired", 1),
    "wide": (2, 40, 16, "separate", 96),
}


def dimensions(name: str, *, own_residuals: bool) -> Dimensions:
    k, reference, residual, layout, width = SIZES[name]
    groups = paper_groups(reference, residual * own_residuals, 1, 2)
    return make_dimensions(k, groups, layout, width, residual)


def made(name: str, *, own_residuals: bool, anchors: int = 60) -> Content:
    """Made-up content; some anchors have no coupled primitive at all."""
    d = dimensions(name, own_residuals=own_residuals)
    content, latents = read_latents(write_content(make_content(anchors, 5, d, kept=0.4)))
    heads = make_heads(np.random.default_rng(10), d)
    assert not content.mask.any(1).all()
    return plain_content(replace(content, heads=heads), latents)


def model_of(content: Content) -> HybridModel:
    """The same in the package's own terms; names and shapes of the tensors must be those of its heads."""
    n, k = content.mask.shape
    tensors = {name: t.astype(np.float32) for name, t in content.heads.items()}
    residuals = content.residuals.astype(np.float32)
    if "residuals" in tensors:
        residuals = tensors.pop("residuals")[np.tile(np.arange(k), n)[content.mask.ravel()]]
    network = "opacity" if content.layout == "separate" else "appearance"
    width = len(tensors[f"{network}.input_bias"])
    dimensions = HeadDimensions(content.references.shape[1], residuals.shape[1], width)
    primitives = PrimitiveArrays(
        positions=(content.coordinates * content.voxel_size).astype(np.float32),
        log_scales=content.log_scales.astype(np.float32),
        references=content.references.astype(np.float32),
        residuals=residuals,
        anchor_index=np.argwhere(content.mask)[:, 0].copy(),
        voxel_size=content.voxel_size,
    )
    heads = HeadWeights(content.layout, dimensions, tensors)
    return HybridModel(primitives, heads, content.view_distance_scale, (0.0, 0.0, 0.0))


def clear_of_the_threshold(everything: list[Primitive]) -> bool:
    return all(abs(p.opacity - CUTOFF) > 1e-4 for p in everything)


def assert_conforms(gaussians: Gaussians, truth: Arrays) -> None:
    assert len(gaussians) == len(truth["mean"]) > 0
    allowed = tolerances(truth)
    for name, field in FIELDS.items():
        found = np.asarray(getattr(gaussians, field), np.float64)
        assert found.shape == truth[name].shape
        assert (np.abs(found - truth[name]) <= allowed[name]).all(), name


@pytest.mark.parametrize("own_residuals", [True, False], ids=["own residuals", "shared residuals"])
@pytest.mark.parametrize("name", SIZES)
def test_a_model_predicts_what_the_document_says(name: str, own_residuals: bool) -> None:
    content = made(name, own_residuals=own_residuals)
    everything = list(primitives(content, CENTER))
    assert clear_of_the_threshold(everything) and len(everything) == content.mask.sum()
    seen = drawn(content, CENTER)
    assert len(seen) > 0 and (len(seen) < len(everything) or name == "one slot")
    truth = stacked(seen)
    model = model_of(content)
    assert_conforms(model.gaussians(camera_at(CENTER)), truth)
    gaussians, index = model.drawn(camera_at(CENTER))
    assert_conforms(gaussians, truth)
    places = {(p.anchor, p.slot): i for i, p in enumerate(everything)}
    assert index.tolist() == [places[p.anchor, p.slot] for p in seen]
    scene = HybridOnDevice.of(model, torch.device("cpu"))
    p, heads = scene.primitive_tensors, scene.networks
    trained = predict(heads, p, torch.tensor(CENTER), content.view_distance_scale)
    assert_conforms(trained.gaussians, truth)


@pytest.mark.parametrize("name", ["paired", "separate", "shallow"])
def test_a_decoded_file_predicts_what_the_document_says(tmp_path: Path, name: str) -> None:
    d = dimensions(name, own_residuals=True)
    made = replace(make_content(80, 7, d, kept=0.5), heads=make_heads(np.random.default_rng(8), d))
    made = replace(made, voxel_size=0.375, view_distance_scale=7.0)
    path = tmp_path / "made.cgs"
    path.write_bytes(write_content(made))
    content = plain_content(*read_latents(path.read_bytes()))
    assert clear_of_the_threshold(list(primitives(content, CENTER)))
    assert_conforms(decode(path).gaussians(camera_at(CENTER)), stacked(drawn(content, CENTER)))


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
def test_an_anchor_at_the_cameras_centre_is_seen_from_no_direction(layout: str) -> None:
    content = made(layout, own_residuals=True)
    places = [tuple(p.tolist()) for p in content.coordinates * content.voxel_size]
    # An anchor that is itself seen from where it stands.
    center = next(c for i, c in enumerate(places) if i in {p.anchor for p in drawn(content, c)})
    assert clear_of_the_threshold(list(primitives(content, center)))
    assert_conforms(model_of(content).gaussians(camera_at(center)), stacked(drawn(content, center)))


def test_a_world_offset_moves_the_camera_and_nothing_else() -> None:
    content = made("paired", own_residuals=True)
    offset = (4.2e6, 5.1e5, -3e3)
    far = replace(content, world_offset=offset)
    x, y, z = (a + b for a, b in zip(CENTER, offset, strict=True))
    near, moved = stacked(drawn(content, CENTER)), stacked(drawn(far, (x, y, z)))
    for name in FIELDS:
        np.testing.assert_allclose(moved[name], near[name], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("layout", ["paired", "separate", "shallow"])
def test_made_up_heads_have_the_tensors_of_the_package(layout: str) -> None:
    d = make_dimensions(3, paper_groups(5, 4, 1, 1), layout, 7)
    expected = {
        name: tuple(p.shape) for name, p in new_heads(layout, HeadDimensions(5, 4, 7)).named_parameters()
    }
    heads = make_heads(np.random.default_rng(1), d)
    assert {name: tensor.values.shape for name, tensor in heads} == head_shapes(d) == expected
    shared = head_shapes(make_dimensions(3, paper_groups(5, 0, 1), layout, 7, 4))
    assert shared == expected | {"residuals": (3, 4)}


def test_the_documents_threshold_is_the_packages() -> None:
    assert CUTOFF == OPACITY_CUTOFF


def test_what_is_not_finite_or_has_no_rotation_is_not_drawn() -> None:
    content = made("one slot", own_residuals=True)
    seen = len(drawn(content, CENTER))
    endless = replace(content, log_scales=content.log_scales + 1e4)
    with np.errstate(over="ignore", invalid="ignore"):
        assert drawn(endless, CENTER) == []
    heads = dict(content.heads)
    for name in ("output_weight", "skip_weight"):
        heads[f"geometry.{name}"] = heads[f"geometry.{name}"] * 0
    heads["geometry.output_bias"] = np.array([0.0] * 6 + [-1.0, 0.0, 0.0, 0.0])
    assert seen > 0 and drawn(replace(content, heads=heads), CENTER) == []
