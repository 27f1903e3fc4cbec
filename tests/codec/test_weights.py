"""Arrays of integers, networks and heads: round trips, size, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from compgs.codec.fields import FieldReader
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.codec.weights import (
    NETWORKS,
    QuantizedTensor,
    decode_arrays,
    decode_heads,
    decode_networks,
    encode_arrays,
    encode_heads,
    encode_networks,
)
from compgs.errors import CorruptSection, NotEncodable

INT32 = st.integers(-(1 << 31), (1 << 31) - 1)


def network(rng: np.random.Generator, *sizes: int) -> IntegerNetwork:
    layers = []
    for i in range(len(sizes) - 1):
        weight = rng.integers(-2048, 2048, (sizes[i + 1], sizes[i])).astype(np.int32)
        bias = rng.integers(-(1 << 31) + 1, 1 << 31, sizes[i + 1])
        layers.append(IntegerLayer(weight, bias, int(rng.integers(0, 31)), bool(rng.integers(2))))
    return IntegerNetwork(tuple(layers))


def same(a: IntegerNetwork, b: IntegerNetwork) -> bool:
    return len(a.layers) == len(b.layers) and all(
        (x.weight == y.weight).all()
        and (x.bias == y.bias).all()
        and (x.shift, x.rectify) == (y.shift, y.rectify)
        and (x.weight.dtype, x.bias.dtype) == (y.weight.dtype, y.bias.dtype)
        for x, y in zip(a.layers, b.layers, strict=True)
    )


@given(
    st.lists(
        st.one_of(
            hnp.arrays(
                np.int32, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=6), elements=INT32
            ),
            hnp.arrays(np.int32, hnp.array_shapes(max_dims=2, max_side=9), elements=st.integers(-60, 60)),
        ),
        min_size=1,
        max_size=5,
    )
)
@settings(max_examples=60, deadline=None)
def test_any_integers_come_back(arrays: list[np.ndarray]) -> None:
    data = encode_arrays(arrays)
    read = decode_arrays(FieldReader(data, "weights"), [a.shape for a in arrays])
    assert all((a == b).all() and a.shape == b.shape for a, b in zip(arrays, read, strict=True))
    assert encode_arrays(read) == data


@pytest.mark.parametrize("spread", [0.02, 1.0, 20.0, 700.0, 9000.0, 1e7])
def test_gaussian_weights_take_their_entropy(spread: float) -> None:
    rng = np.random.default_rng(1)
    values = np.rint(rng.standard_normal(6000) * spread).astype(np.int32)
    bits = 8 * len(encode_arrays([values]))
    continuous = 6000 * np.log2(spread * np.sqrt(2 * np.pi * np.e))
    _, counts = np.unique(values, return_counts=True)
    histogram = float(-(counts * np.log2(counts / 6000)).sum())
    assert bits < max(continuous if spread > 1 else histogram, 0) * 1.01 + 160


@given(st.integers(0, 1 << 30), st.lists(st.integers(1, 20), max_size=2))
@settings(max_examples=25, deadline=None)
def test_networks_come_back(seed: int, hidden: list[int]) -> None:
    rng = np.random.default_rng(seed)
    sizes = {"reference": (4, 10), "covariance": (5, 12), "residual": (9, 6)}
    written = {name: network(rng, sizes[name][0], *hidden, sizes[name][1]) for name in NETWORKS}
    data = encode_networks(written)
    read = decode_networks(data, "entropy networks", sizes)
    assert all(same(written[name], read[name]) for name in NETWORKS)
    with pytest.raises(CorruptSection, match="entropy networks"):
        decode_networks(data, "entropy networks", sizes | {"covariance": (5, 14)})
    for size in range(0, len(data), 7):
        with pytest.raises(CorruptSection, match="entropy networks"):
            decode_networks(data[:size], "entropy networks", sizes)


@given(
    st.dictionaries(
        st.text(st.characters(codec="utf-8"), min_size=1, max_size=12),
        st.tuples(
            hnp.arrays(np.int32, hnp.array_shapes(min_dims=0, max_dims=3, max_side=5), elements=INT32),
            st.integers(-62, 62),
        ),
        max_size=6,
    )
)
@settings(max_examples=50, deadline=None)
def test_heads_come_back(tensors: dict[str, tuple[np.ndarray, int]]) -> None:
    written = tuple((name, QuantizedTensor(values, exponent)) for name, (values, exponent) in tensors.items())
    data = encode_heads(written)
    read = decode_heads(data, "prediction heads")
    assert [name for name, _ in read] == [name for name, _ in written]
    for (_, a), (_, b) in zip(read, written, strict=True):
        assert a.exponent == b.exponent and a.values.shape == b.values.shape and (a.values == b.values).all()
    assert encode_heads(read) == data


def test_heads_beyond_the_limits_are_refused_before_anything_is_written() -> None:
    tensor = QuantizedTensor(np.zeros(3, np.int32), 4)
    for heads, complaint in [
        ((("a", tensor), ("a", tensor)), "same name"),
        ((("", tensor),), "bytes"),
        ((("x" * 65, tensor),), "bytes"),
        ((("a", QuantizedTensor(np.zeros(3, np.int32), 63)),), "exponent"),
        ((("a", QuantizedTensor(np.zeros((1,) * 5, np.int32), 0)),), "rank"),
        (tuple((str(i), tensor) for i in range(257)), "at most 256"),
        ((("a", QuantizedTensor(np.zeros((1 << 16, 65), np.int32), 0)),), "weights"),
    ]:
        with pytest.raises(NotEncodable, match=complaint):
            encode_heads(heads)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x81\x02",  # 257 tensors
        b"\x01\x01\x00",  # a prefix shared with nothing
        b"\x01\x00\x00\x00\x00",  # no name
        b"\x01\x00\x01a\x05",  # rank 5
        b"\x01\x00\x01a\x02\x80\x80\x04\x80\x80\x04\x00",  # 2^32 weights
        b"\x01\x00\x01\xff\x00\x00\x00\x00\x00",  # not UTF-8
        b"\x00\x00",  # a byte too many
    ],
)
def test_absurd_heads_are_refused_by_name(data: bytes) -> None:
    with pytest.raises(CorruptSection, match="prediction heads"):
        decode_heads(data, "prediction heads")


def test_bits_behind_the_last_low_bit_must_be_zero() -> None:
    values = np.array([100_000, -70_000, 3], np.int32)
    data = bytearray(encode_arrays([values]))
    data[-1] |= 1
    with pytest.raises(CorruptSection, match="low bit"):
        decode_arrays(FieldReader(bytes(data), "weights"), [(3,)])
