"""Networks and primitives as arrays, against the readable torch and numbers by hand."""

import numpy as np
import pytest
import torch

from compgs.model.arrays import ALL_ROWS, MLPArrays, PrimitiveArrays
from compgs.tensors.primitives import Primitives
from compgs.tensors.residual_mlp import ResidualMLP


def arrays_of(network: ResidualMLP) -> MLPArrays:
    return MLPArrays.of({name: p.detach().numpy() for name, p in network.named_parameters()}, 6)


def arrays_with(anchor_index: list[int], anchors: int) -> PrimitiveArrays:
    coupled = len(anchor_index)
    return Primitives(
        positions=torch.zeros(anchors, 3),
        log_scales=torch.arange(6.0).repeat(anchors, 1).log(),
        references=torch.zeros(anchors, 2),
        residuals=torch.zeros(coupled, 1),
        anchor_index=torch.tensor(anchor_index, dtype=torch.int64),
        voxel_size=0.5,
    ).arrays()


def test_coupled_primitives_of_an_anchor_begin_where_the_last_ones_end():
    assert arrays_with([0, 0, 2, 2, 2], 5).first_coupled().tolist() == [0, 2, 2, 5, 5, 5]
    empty = arrays_with([], 2).first_coupled()
    assert empty.tolist() == [0, 0, 0] and empty.dtype == np.int64


def test_the_spread_of_an_anchor_is_in_world_units():
    p = arrays_with([0], 1)
    assert p.spread().dtype == np.float32
    assert p.spread()[0] == pytest.approx([0, 0.5, 1, 1.5, 2, 2.5], rel=1e-6)


@pytest.mark.parametrize("blocks", [0, 1, 2, 11])
def test_a_network_of_arrays_is_the_network_of_torch_in_float64(blocks):
    torch.manual_seed(0)
    network = ResidualMLP(6, 4, 5, 16, blocks)
    exact = ResidualMLP(6, 4, 5, 16, blocks).double()
    exact.load_state_dict(network.state_dict())
    g = torch.Generator().manual_seed(1)
    features, residuals = torch.randn(300, 6, generator=g), torch.randn(900, 4, generator=g)
    index = torch.randint(0, 300, (900,), generator=g).sort().values
    arrays = arrays_of(network)
    expected = exact(features.double(), residuals.double(), index).detach().numpy()
    everything = features.numpy(), residuals.numpy()
    found = arrays.apply(*everything, index.numpy())
    scale = np.abs(expected).max()
    assert np.abs(found - expected).max() < 1e-5 * scale
    rows = np.arange(0, 900, 7)
    some = arrays.apply(*everything, index.numpy()[rows], rows)
    assert np.abs(some - expected[rows]).max() < 1e-5 * scale
    assert arrays.apply(*everything, ALL_ROWS, ALL_ROWS).shape == (0, 5)


def test_arrays_are_made_of_a_files_tensors_in_whatever_order_they_come():
    network = ResidualMLP(6, 4, 5, 16, 12)
    tensors = {name: p.detach().numpy() for name, p in sorted(network.named_parameters())}
    for a, b in zip(MLPArrays.of(tensors, 6).whole, arrays_of(network).whole, strict=True):
        assert np.array_equal(a, b) and a.flags.c_contiguous
