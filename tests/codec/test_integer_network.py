"""Integer networks: the float64 evaluation against int64, however it is cut, ordered or threaded."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

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

    def clamp(y: np.ndarray) -> np.ndarray:
        return np.clip(y, -(1 << 23), (1 << 23) - 1)

    inputs = clamp(x.astype(np.int64))
    before, taken = inputs, inputs
    for i, layer in enumerate(network.layers):
        if network.skip and i == len(network.layers) - 1:
            taken = np.concatenate([taken, inputs], 1)
        y = taken @ layer.weight.astype(np.int64).T
        if layer.shift > 0:
            y = (y + (1 << (layer.shift - 1))) >> layer.shift
        y = y + layer.bias
        if layer.rectify:
            y = np.maximum(y, y >> 6)
        y = clamp(y)
        if layer.adds:
            y = clamp(y + before)
        before, taken = taken, y
    return taken


def random_network(
    seed: int, sizes: list[int], bits: int = 12, shift: int = 9, *, skip: bool = False, adds: bool = False
) -> IntegerNetwork:
    """`adds`: wherever a layer may."""
    rng = np.random.default_rng(seed)
    limit = 1 << (bits - 1)
    layers = []
    last = len(sizes) - 2
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        taken = n_in + (sizes[0] if skip and i == last else 0)
        layers.append(
            IntegerLayer(
                weight=rng.integers(-limit, limit, (n_out, taken)).astype(np.int32),
                bias=rng.integers(-(1 << 20), 1 << 20, n_out),
                shift=shift,
                rectify=i < last,
                adds=adds and 0 < i < last and sizes[i - 1] == n_out,
            )
        )
    return IntegerNetwork(tuple(layers), skip)


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


@given(
    st.integers(0, 1 << 30),
    st.integers(1, 20),
    st.integers(1, 20),
    st.integers(1, 3),
    st.booleans(),
    st.integers(6, 16),
    st.integers(0, 20),
    st.integers(0, 30),
)
@settings(max_examples=60, deadline=None)
def test_residual_networks_equal_int64(
    seed: int, inputs: int, width: int, blocks: int, skip: bool, bits: int, shift: int, spread: int
) -> None:
    """Inputs as wide as the hidden layers among them: then the second layer adds the inputs themselves."""
    sizes = [inputs, *[width] * (1 + 2 * blocks), 6]
    network = random_network(seed, sizes, bits, shift, skip=skip, adds=True)
    assert sum(layer.adds for layer in network.layers) == 2 * blocks - (inputs != width)
    x = np.random.default_rng(seed).integers(-(1 << spread), 1 << spread, (50, inputs))
    y = slow_evaluate(network, x)
    assert (evaluate(network, x) == y).all()
    means, index = entropy_parameters(network, x)
    assert (means == y[:, :3]).all()
    assert (index == np.clip((y[:, 3:] + 2048) >> 12, 0, 127)).all()


def test_a_branch_is_added_to_what_it_began_with() -> None:
    """In numbers: h = x + 1; h + (2 h - 3); twice that, and three times the input beside it."""

    def layer(weight: list[int], bias: int, *, adds: bool = False) -> IntegerLayer:
        return IntegerLayer(np.array([weight], np.int32), np.array([bias]), 0, False, adds)

    network = IntegerNetwork(
        (layer([1], 1), layer([2], 0), layer([1], -3, adds=True), layer([2, 3], 0)), True
    )
    x = np.array([[5], [-7], [1 << 22]])
    assert evaluate(network, x)[:2].ravel().tolist() == [2 * (6 + 9) + 15, 2 * (-6 - 15) - 21]
    # The sum is clamped, as everything is, and so is what follows: (2^23 - 1) times two leaves the range.
    assert evaluate(network, x)[2, 0] == (1 << 23) - 1


def test_sums_of_branches_are_clamped_at_both_ends() -> None:
    top, bottom = (1 << 23) - 1, -(1 << 23)
    one = IntegerLayer(np.array([[1]], np.int32), np.array([0]), 0, False)
    network = IntegerNetwork((one, one, replace(one, adds=True), one))
    x = np.array([[top], [bottom], [1 << 22], [-(1 << 22)], [(1 << 22) - 1], [1 << 40], [-(1 << 40)]])
    assert evaluate(network, x).ravel().tolist() == [top, bottom, top, bottom, top - 1, top, bottom]


def test_accumulators_of_a_skip_at_the_limit_are_exact() -> None:
    """The last layer sums hidden activations and inputs: together they must stay below 2^52."""
    hidden, inputs = 300, 212
    largest = (1 << 52) // ((hidden + inputs) * ACTIVATION_LIMIT) - 1
    rng = np.random.default_rng(5)
    signs = rng.choice([-1, 1], (hidden, inputs))
    first = IntegerLayer((signs << 12).astype(np.int32), np.zeros(hidden, np.int64), 0, True)
    again = IntegerLayer(np.eye(hidden, dtype=np.int32), np.zeros(hidden, np.int64), 0, False, False)
    weight = np.full((4, hidden + inputs), largest, np.int32)
    weight[1] *= -1
    weight[2, ::2] *= -1
    weight[3, 1:] -= 1
    last = IntegerLayer(weight, np.array([-1, 0, 1, 2]), 30, False)
    network = IntegerNetwork((first, again, replace(again, adds=True), last), True)
    x = np.where(signs[:50] > 0, ACTIVATION_LIMIT - 1, -ACTIVATION_LIMIT)
    x[0], x[1] = -ACTIVATION_LIMIT, ACTIVATION_LIMIT - 1
    assert (evaluate(network, x) == slow_evaluate(network, x)).all()
    over = replace(last, weight=np.full((4, hidden + inputs), largest + 1, np.int32))
    with pytest.raises(ValueError, match=r"layer 3: 512 inputs .* 2\^52"):
        IntegerNetwork((first, again, replace(again, adds=True), over), True)


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


def test_results_do_not_depend_on_batch_order_or_threads(
    monkeypatch: pytest.MonkeyPatch, with_threads: Callable[[int], None]
) -> None:
    with_threads(2)
    network = random_network(1, [42, 64, 64, 64, 160], skip=True, adds=True)
    rng = np.random.default_rng(2)
    x = rng.integers(-(1 << 18), 1 << 18, (20_000, 42)).astype(np.int32)
    whole = evaluate(network, x)
    order = rng.permutation(len(x))
    assert (evaluate(network, x[order]) == whole[order]).all()
    assert (evaluate(network, x[:1]) == whole[:1]).all()
    columns = rng.permutation(42)
    first = network.layers[0]
    last = network.layers[-1]
    behind = np.concatenate([np.arange(64), 64 + columns])
    shuffled = IntegerNetwork(
        (
            replace(first, weight=first.weight[:, columns]),
            *network.layers[1:-1],
            replace(last, weight=last.weight[:, behind]),
        ),
        skip=True,
    )
    assert (evaluate(shuffled, x[:, columns]) == whole).all()
    with_threads(1)
    monkeypatch.setattr(integer_network, "BLOCK_ROWS", 333)
    assert (evaluate(network, x) == whole).all()


@pytest.mark.gpu
def test_cuda_gives_the_same_integers() -> None:
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    network = random_network(3, [42, 64, 64, 64, 160], bits=16, shift=12, skip=True, adds=True)
    x = np.random.default_rng(4).integers(-(1 << 23), 1 << 23, (5000, 42))
    inputs = torch.from_numpy(x).cuda().double()
    before, y = inputs, inputs
    for i, layer in enumerate(network.layers):
        start = before
        before = y
        if i == len(network.layers) - 1:
            y = torch.cat([y, inputs], 1)
        y = y @ torch.from_numpy(layer.weight.T.astype(np.float64)).cuda()
        y = torch.floor((y + (2.0 ** (layer.shift - 1) if layer.shift else 0.0)) * 2.0**-layer.shift)
        y = y + torch.from_numpy(layer.bias.astype(np.float64)).cuda()
        if layer.rectify:
            y = torch.maximum(y, torch.floor(y / 64))
        y = y.clamp(-(2.0**23), 2.0**23 - 1)
        if layer.adds:
            y = (y + start).clamp(-(2.0**23), 2.0**23 - 1)
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


def plain_layer(inputs: int, outputs: int, *, adds: bool = False) -> IntegerLayer:
    weight = np.ones((outputs, inputs), np.int32)
    return IntegerLayer(weight, np.zeros(outputs, np.int64), 0, False, adds)


@pytest.mark.parametrize(
    ("layers", "skip", "complaint"),
    [
        ([plain_layer(3, 3, adds=True), plain_layer(3, 3), plain_layer(3, 3)], False, "layer 0: 3 outputs"),
        ([plain_layer(3, 3), plain_layer(3, 3), plain_layer(3, 3, adds=True)], False, "layer 2: 3 outputs"),
        ([plain_layer(3, 3, adds=True)], False, "layer 0: 3 outputs"),
        (
            [plain_layer(2, 3), plain_layer(3, 4), plain_layer(4, 4, adds=True), plain_layer(4, 2)],
            False,
            "layer 2: 4 outputs cannot be added",
        ),
        ([plain_layer(3, 3), plain_layer(3, 1, adds=True), plain_layer(1, 3)], False, "layer 1: 1 outputs"),
        ([plain_layer(3, 3)], True, "a skip needs layers"),
        ([plain_layer(3, 4), plain_layer(4, 3)], True, r"layer 1: weight .* expected \[out, 7\]"),
        ([plain_layer(3, 4), plain_layer(7, 3)], False, r"layer 1: weight .* expected \[out, 4\]"),
    ],
)
def test_branches_and_skips_that_do_not_fit_are_refused(
    layers: list[IntegerLayer], skip: bool, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        IntegerNetwork(tuple(layers), skip)
