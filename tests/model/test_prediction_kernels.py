"""Each kernel of the prediction against its readable twin in float64."""

import numba
import numpy as np
import pytest
import torch

from compgs.model import prediction_kernels as kernels
from compgs.model.constants import OPACITY_CUTOFF
from compgs.model.network_kernels import ANCHORS, ROWS
from compgs.tensors.prediction import (
    affine_transform,
    color_activation,
    is_drawn,
    opacity_activation,
    view_embedding,
)
from compgs.tensors.residual_mlp_kernels import CHUNKS, chunk_bounds

A = 30
SIZES = [0, 1, ROWS - 1, ROWS, 3 * ROWS + 5]


def normal(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def anchors_of(m: int) -> np.ndarray:
    return np.sort(np.random.default_rng(1).integers(0, A, m))


def wide(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array).double()


def room(*shape: int) -> np.ndarray:
    """What a kernel has to fill completely."""
    return np.full(shape, np.nan, np.float32)


def test_the_sigmoid_is_right_to_single_precision_everywhere():
    x = np.concatenate([np.linspace(-100, 100, 40_001), [-1e30, -np.inf, np.inf, 1e30, 0.0]])
    x = x.astype(np.float32)
    found = numba.vectorize(["f4(f4)"])(lambda t: kernels.sigmoid(t))(x)
    with np.errstate(over="ignore"):
        expected = 1 / (1 + np.exp(-x.astype(np.float64)))
    assert np.abs(found - expected).max() < 2e-7


@pytest.mark.parametrize("m", SIZES)
@pytest.mark.parametrize("columns", [1, 4])
def test_opacities_are_those_of_the_first_column(m, columns):
    raw, found = 3 * normal(m, columns), room(m)
    kernels.activate_opacities(raw, found)
    assert np.allclose(found, opacity_activation(wide(raw)), atol=5e-7, rtol=0)


@pytest.mark.parametrize("m", SIZES)
@pytest.mark.parametrize("columns", [3, 4])
def test_colors_are_those_of_the_last_three_columns_of_the_chosen_rows(m, columns):
    raw, found = 3 * normal(2 * m, columns), room(m, 3)
    rows = np.arange(m) * 2
    kernels.activate_colors(raw, rows, found)
    assert np.allclose(found, color_activation(wide(raw)[rows, -3:]), atol=2e-7, rtol=0)


def test_an_opacity_of_exactly_the_cutoff_is_not_drawn_by_either():
    at = np.float32(OPACITY_CUTOFF)
    opacities = np.array([np.nextafter(at, np.float32(0)), at, np.nextafter(at, np.float32(1)), -1, np.nan])
    opacities = opacities.astype(np.float32)
    found = numba.vectorize(["b1(f4)"])(lambda o: kernels.is_drawn(o))(opacities)
    assert found.tolist() == is_drawn(torch.from_numpy(opacities)).tolist() == [0, 0, 1, 0, 0]


@pytest.mark.parametrize("m", SIZES)
def test_the_affine_map_is_that_of_the_readable_version(m):
    raw, positions, spread = 2 * normal(m, 10), 5 * normal(A, 3, seed=2), np.exp(normal(A, 6, seed=3))
    anchor = anchors_of(m)
    found = room(m, 3), room(m, 3), room(m, 4)
    kernels.affine_transform(raw, anchor, positions, spread, *found)
    place, reach, sizes = (wide(x)[anchor] for x in (positions, spread[:, :3], spread[:, 3:]))
    for a, b in zip(found, affine_transform(wide(raw), place, reach, sizes), strict=True):
        assert np.allclose(a, b, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("m", SIZES)
def test_gradients_of_all_activations_are_those_of_float64_autograd(m):
    anchor = anchors_of(m)
    appearance, geometry = wide(normal(m, 4, seed=4)), wide(normal(m, 10, seed=5))
    log_scales, positions = wide(normal(A, 6, seed=6)), wide(normal(A, 3, seed=7))
    inputs = [t.requires_grad_() for t in (appearance, geometry, log_scales)]
    spread = log_scales.exp() * 0.05
    means, scales, quaternions = affine_transform(
        geometry, positions[anchor], spread[anchor, :3], spread[anchor, 3:]
    )
    activated = (
        means,
        scales,
        quaternions,
        opacity_activation(appearance),
        color_activation(appearance[:, 1:]),
    )
    by_activated = [normal(*t.shape, seed=8 + i) for i, t in enumerate(activated)]
    truth = torch.autograd.grad(activated, inputs, [wide(g) for g in by_activated])

    opacities, colors, scales, spread, translations = (
        np.ascontiguousarray(t.detach().numpy(), np.float32)
        for t in (activated[3], activated[4], scales, spread, geometry[:, :3])
    )
    found = room(m, 4), room(m, 10), np.zeros((A, 6), np.float32)
    bounds = chunk_bounds(anchor, CHUNKS)
    kernels.activation_gradients(
        opacities, colors, translations, scales, spread, anchor, *by_activated, bounds, *found
    )
    for a, b in zip(found, truth, strict=True):
        assert np.allclose(a, b, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("v", [0, 1, ANCHORS, 2 * ANCHORS + 3])
def test_anchors_are_seen_with_references_and_view_embeddings(v):
    n, d, center, unit = 3 * ANCHORS, 5, normal(3, seed=3), 4.0
    positions, references, anchors = 5 * normal(n, 3), normal(n, d, seed=2), np.arange(v) + 7
    positions[9] = center  # seen from no direction, at a distance of 0
    found = room(v, d + 4)
    kernels.see(anchors, positions, references, center, np.float32(unit), found)
    expected = view_embedding(wide(positions)[anchors], wide(center), unit)
    assert np.array_equal(found[:, :d], references[anchors])
    assert np.allclose(found[:, d:], expected, atol=1e-6, rtol=1e-6)
    if v > 2:
        assert found[2, d:].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("m", SIZES)
def test_geometry_is_gathered_row_by_row(m):
    everything = normal(2 * m, 3), normal(2 * m, 3, seed=1), normal(2 * m, 4, seed=2)
    index, found = np.arange(m) * 2 + 1, (room(m, 3), room(m, 3), room(m, 4))
    kernels.gather_geometry(index, *everything, *found)
    for a, b in zip(found, everything, strict=True):
        assert np.array_equal(a, b[index])
