"""Separate and paired heads behind one interface."""

import numpy as np
import pytest
import torch

from compgs.model import HeadDimensions
from compgs.model.head_weights import weight_shapes
from compgs.tensors.heads import OPACITY_BIAS, PairedHeads, SeparateHeads, heads_of, make_heads

D, G, A, M = 12, 8, 30, 200
LAYOUTS = ["paired", "separate"]


def made(layout):
    torch.manual_seed(0)
    return make_heads(layout, HeadDimensions(D, G, 16)).requires_grad_(False)


def inputs():
    g = torch.Generator().manual_seed(1)
    index = torch.randint(0, A, (M,), generator=g).sort().values
    return (
        torch.randn(A, D, generator=g),
        torch.randn(A, D + 4, generator=g),
        torch.randn(M, G, generator=g),
        index,
    )


def test_a_layout_names_one_kind_of_heads():
    assert type(made("paired")) is PairedHeads and type(made("separate")) is SeparateHeads


def test_networks_come_in_the_order_of_the_file():
    assert [name for name, _ in made("paired").networks()] == ["geometry", "appearance"]
    names = [name for name, _ in made("separate").networks()]
    assert names == ["translation", "covariance", "opacity", "color"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_raw_numbers_are_the_networks_outputs_side_by_side(layout):
    heads, (f, seen, g, index) = made(layout), inputs()
    networks = dict(heads.networks())
    geometry, opacity, color = heads.raw_geometry(f, g, index), heads.raw_appearance(seen, g, index), None
    if layout == "paired":
        both = networks["appearance"](seen, g, index)
        assert torch.equal(geometry, networks["geometry"](f, g, index))
        assert torch.equal(opacity, both)
        color = both[:, 1:]
    else:
        assert torch.equal(geometry[:, :3], networks["translation"](f, g, index))
        assert torch.equal(geometry[:, 3:], networks["covariance"](f, g, index))
        assert torch.equal(opacity, networks["opacity"](seen, g, index))
        color = networks["color"](seen, g, index)
    assert geometry.shape == (M, 10) and color.shape == (M, 3)
    assert torch.equal(heads.raw_color(opacity, None, seen, g, index), color)
    some = torch.arange(0, M, 3)
    torch.testing.assert_close(heads.raw_color(opacity, some, seen, g[some], index[some]), color[some])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_arrays_of_the_heads_give_the_same_geometry(layout):
    heads, (f, _, g, index) = made(layout), inputs()
    found = heads.weights().arrays().raw_geometry(f.numpy(), g.numpy(), index.numpy())
    exact = heads.double().raw_geometry(f.double(), g.double(), index).numpy()
    assert np.abs(found - exact).max() < 1e-5 * np.abs(exact).max()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_weights_have_the_shapes_that_files_must_have_and_make_the_same_heads(layout):
    heads = made(layout)
    weights = heads.weights()
    found = {name: tensor.shape for name, tensor in weights.tensors.items()}
    assert found == weight_shapes(layout, HeadDimensions(D, G, 16))
    again = dict(heads_of(weights).named_parameters())
    assert all(torch.equal(again[name], p) for name, p in heads.named_parameters())
    assert not any(p.requires_grad for p in again.values())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_opacity_starts_where_a_gradient_flows(layout):
    networks = dict(made(layout).networks())
    opacity = networks["appearance" if layout == "paired" else "opacity"]
    assert opacity.output_bias[0] == pytest.approx(OPACITY_BIAS)
    assert all(
        network.output_bias[0] != pytest.approx(OPACITY_BIAS)
        for network in networks.values()
        if network is not opacity
    )


@pytest.mark.parametrize("layout", LAYOUTS)
def test_readers_are_the_layers_that_take_references(layout):
    heads, (f, seen, g, index) = made(layout), inputs()
    for reader in heads.readers(0.5):
        reader.weight[:D] = 0
        assert (reader.dimension, reader.first, reader.unit) == (0, 0, 0.5)
    other = seen.clone()
    other[:, :D] += 1
    assert torch.equal(heads.raw_geometry(f, g, index), heads.raw_geometry(f + 1, g, index))
    assert torch.equal(heads.raw_appearance(seen, g, index), heads.raw_appearance(other, g, index))
