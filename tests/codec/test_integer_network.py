"""Integer networks: the float64 evaluation against int64, however it is cut, ordered or threaded."""

from itertools import pairwise

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.codec import integer_network
from compgs.codec.integer_network import (
    ACTIVATION_LIMIT,
    IntegerLayer,
    IntegerNetwork,
    entropy_parameters,
    evaluate,
)


def slow_evaluate(network: IntegerNetwork, x: np.ndarray) -> np.ndarray:
    """Slow twin: Python integers' semantics, in int64."""
    y = np.clip(x.astype(np.int64), -(1 << 23), (1 << 23) - 1)
    for layer in network.layers:
        y = y @ layer.weight.astype(np.int64).T
        if layer.shift > 0:
            y = (y + (1 << (layer.shift - 1))) >> layer.shift
        y = y + layer.bias
        if layer.rectify:
            y = np.maximum(y, y >> 6)
        y = np.clip(y, -(1 << 23), (1 << 23) - 1)
    return y


def random_network(seed: int, sizes: list[int], bits: int = 12, shift: int = 9) -> IntegerNetwork:
    rng = np.random.default_rng(seed)
    limit = 1 << (bits - 1)
    return IntegerNetwork(
        tuple(
            IntegerLayer(
                weight=rng.integers(-limit, limit, (n_out, n_in)).astype(np.int32),
                bias=rng.integers(-(1 << 20), 1 << 20, n_out),
                shift=shift,
                rectify=i < len(sizes) - 2,
            )
            for i, (n_in, n_out) in enumerate(pairwise(sizes))
        )
    )


@given(
    st.integers(0, 1 << 30),
    st.lists(st.integers(1, 40), min_size=2, max_size=4),
    st.integers(6, 16),
    st.integers(0, 30),
    st.integers(0, 30),
)
@settings(max_examples=60, deadline=None)
def test_float64_evaluation_equals_int64(
    seed: int, sizes: list[int], bits: int, shift: int, spread: int
) -> None:
    network = random_network(seed, sizes, bits, shift)
    x = np.random.default_rng(seed).integers(-(1 << spread), 1 << spread, (50, sizes[0]))
    assert (evaluate(network, x) == slow_evaluate(network, x)).all()


def test_accumulators_at_the_limit_are_exact() -> None:
    inputs = 1000
    largest = (1 << 52) // (inputs * ACTIVATION_LIMIT) - 1
    weight = np.full((4, inputs), largest, np.int32)
    weight[1] *= -1
    weight[2, ::2] *= -1
    weight[3, 1:] -= 1
    network = IntegerNetwork((IntegerLayer(weight, np.array([-1, 0, 1, 2]), 30, False),))
    x = np.full((3, inputs), -ACTIVATION_LIMIT, np.int64)
    x[1] = ACTIVATION_LIMIT - 1
    x[2, ::3] = ACTIVATION_LIMIT - 1
    assert (evaluate(network, x) == slow_evaluate(network, x)).all()


def test_results_do_not_depend_on_batch_order_or_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    network = random_network(1, [42, 64, 160])
    rng = np.random.default_rng(2)
    x = rng.integers(-(1 << 18), 1 << 18, (20_000, 42)).astype(np.int32)
    whole = evaluate(network, x)
    order = rng.permutation(len(x))
    assert (evaluate(network, x[order]) == whole[order]).all()
    assert (evaluate(network, x[:1]) == whole[:1]).all()
    columns = rng.permutation(42)
    first = network.layers[0]
    shuffled = IntegerNetwork(
        (IntegerLayer(first.weight[:, columns], first.bias, first.shift, first.rectify), network.layers[1])
    )
    assert (evaluate(shuffled, x[:, columns]) == whole).all()
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        monkeypatch.setattr(integer_network, "BLOCK_ROWS", 333)
        assert (evaluate(network, x) == whole).all()
    finally:
        numba.set_num_threads(threads)


@pytest.mark.gpu
def test_cuda_gives_the_same_integers() -> None:
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    network = random_network(3, [42, 64, 160], bits=16, shift=12)
    x = np.random.default_rng(4).integers(-(1 << 23), 1 << 23, (5000, 42))
    y = torch.from_numpy(x).cuda().double()
    for layer in network.layers:
        y = y @ torch.from_numpy(layer.weight.T.astype(np.float64)).cuda()
        y = torch.floor((y + (2.0 ** (layer.shift - 1) if layer.shift else 0.0)) * 2.0**-layer.shift)
        y = y + torch.from_numpy(layer.bias.astype(np.float64)).cuda()
        if layer.rectify:
            y = torch.maximum(y, torch.floor(y / 64))
        y = y.clamp(-(2.0**23), 2.0**23 - 1)
    assert (y.cpu().numpy() == evaluate(network, x)).all()


def test_entropy_parameters_round_and_clamp_the_scales() -> None:
    bias = np.array([7, -8, 9, 10, 11, 2047, 2048, -1 << 20, 1 << 22, (60 << 12) - 2049])
    network = IntegerNetwork((IntegerLayer(np.zeros((10, 1), np.int32), bias, 0, False),))
    means, index = entropy_parameters(network, np.zeros((2, 1), np.int32))
    assert means.tolist() == [[7, -8, 9, 10, 11]] * 2
    assert index.tolist() == [[0, 1, 0, 127, 59]] * 2
    assert means.dtype == np.int32 and index.dtype == np.uint8


@pytest.mark.parametrize(
    ("weight", "bias", "shift", "complaint"),
    [
        (np.ones((3, 2), np.int32), np.zeros(2, np.int64), 0, "bias"),
        (np.ones((3, 2), np.int32), np.zeros(3, np.int64), 31, "shift"),
        (np.ones((3, 2), np.int32), np.full(3, 1 << 31), 0, "2\\^31"),
        (np.full((3, 2), 1 << 28, np.int32), np.zeros(3, np.int64), 0, "2\\^52"),
        (np.full((1, 1), -(1 << 31), np.int32), np.zeros(1, np.int64), 0, "2\\^52"),
        (np.ones((0, 2), np.int32), np.zeros(0, np.int64), 0, "shape"),
        (np.ones(3, np.int32), np.zeros(3, np.int64), 0, "shape"),
    ],
)
def test_networks_that_could_be_inexact_are_refused(
    weight: np.ndarray, bias: np.ndarray, shift: int, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        IntegerNetwork((IntegerLayer(weight, bias, shift, False),))


def test_layers_must_fit_together() -> None:
    a = IntegerLayer(np.ones((3, 2), np.int32), np.zeros(3, np.int64), 0, True)
    b = IntegerLayer(np.ones((2, 4), np.int32), np.zeros(2, np.int64), 0, False)
    with pytest.raises(ValueError, match="layer 1"):
        IntegerNetwork((a, b))
    with pytest.raises(ValueError, match="at least one"):
        IntegerNetwork(())
