"""Arrays of integers, networks and heads: round trips, size, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from compgs.codec.fields import FieldReader, varint
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork
from compgs.codec.rows import RowContext
from compgs.codec.weights import (
    ADDS,
    MAX_WEIGHTS,
    RECTIFY,
    RESERVED,
    QuantizedTensor,
    decode_arrays,
    decode_heads,
    decode_known_heads,
    decode_networks,
    encode_arrays,
    encode_heads,
    encode_known_heads,
    encode_networks,
)
from compgs.errors import CorruptSection, NotEncodable

INT32 = st.integers(-(1 << 31), (1 << 31) - 1)


def network(rng: np.random.Generator, *sizes: int, skip: bool = False, adds: bool = False) -> IntegerNetwork:
    """`adds`: wherever a layer may."""
    layers = []
    last = len(sizes) - 2
    for i in range(len(sizes) - 1):
        taken = sizes[i] + (sizes[0] if skip and i == last else 0)
        weight = rng.integers(-2048, 2048, (sizes[i + 1], taken)).astype(np.int32)
        bias = rng.integers(-(1 << 31) + 1, 1 << 31, sizes[i + 1])
        branch = adds and 0 < i < last and sizes[i - 1] == sizes[i + 1]
        layers.append(IntegerLayer(weight, bias, int(rng.integers(0, 31)), bool(rng.integers(2)), branch))
    return IntegerNetwork(tuple(layers), skip)


def same(a: IntegerNetwork, b: IntegerNetwork) -> bool:
    return (len(a.layers), a.skip) == (len(b.layers), b.skip) and all(
        (x.weight == y.weight).all()
        and (x.bias == y.bias).all()
        and (x.shift, x.rectify, x.adds) == (y.shift, y.rectify, y.adds)
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


@given(st.integers(0, 1 << 30), st.lists(st.integers(1, 4), max_size=7), st.booleans())
@settings(max_examples=40, deadline=None)
def test_networks_come_back(seed: int, hidden: list[int], skip: bool) -> None:
    rng = np.random.default_rng(seed)
    sizes = [(4, 10), (5, 12), (9, 1)]
    skip = skip and len(hidden) > 0
    written = [network(rng, a, *hidden, b, skip=skip, adds=True) for a, b in sizes]
    data = encode_networks(written)
    read = decode_networks(data, "entropy networks", sizes)
    assert all(same(a, b) for a, b in zip(written, read, strict=True))
    assert encode_networks(read) == data
    with pytest.raises(CorruptSection, match="entropy networks"):
        decode_networks(data, "entropy networks", [sizes[0], (5, 14), sizes[2]])
    for size in (*rng.integers(0, len(data), 12).tolist(), len(data) - 1):
        with pytest.raises(CorruptSection, match="entropy networks"):
            decode_networks(data[:size], "entropy networks", sizes)


def test_no_networks_take_no_bytes() -> None:
    assert encode_networks([]) == b""
    assert decode_networks(b"", "entropy networks", []) == []
    with pytest.raises(CorruptSection, match="left over"):
        decode_networks(b"\0", "entropy networks", [])


def network_bytes(*layers: tuple[int, int], flags: int = 0, inertia: int = 0) -> bytes:
    """The fields of a network: its flags, (width, flags) of its layers, its inertia."""
    widths = b"".join(varint(width) + bytes([f]) for width, f in layers)
    return bytes([len(layers), flags]) + widths + bytes([inertia])


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (network_bytes((4, 0), flags=1), "flags of network 0 are 1"),
        (network_bytes((4, 0), (4, 0), flags=4), "flags of network 0 are 4"),
        (network_bytes((4, 0), (4, 0), flags=0x80), "flags of network 0 are 128"),
        (network_bytes((4, RESERVED)), "layer 0 of network 0: flags are 0x20"),
        (network_bytes((3, RECTIFY), (4, RESERVED | 5)), "layer 1 of network 0: flags are 0x25"),
        (network_bytes((4, 31)), "layer 0 of network 0: flags are 0x1f"),
        (network_bytes((3, ADDS), (4, 0)), "layer 0 of network 0: its outputs cannot be added"),
        (network_bytes((4, ADDS)), "layer 0 of network 0: its outputs cannot be added"),
        (network_bytes((3, 0), (3, 0), (3, ADDS)), "layer 2 of network 0: its outputs cannot be added"),
        (network_bytes((5, 0), (5, ADDS), (4, 0)), "layer 1 of network 0: its outputs cannot be added"),
        (network_bytes((3, 0), (5, 0), (5, ADDS), (4, 0)), "layer 2 of network 0: its outputs cannot be"),
        (network_bytes((0, 0)), "width of layer 0"),
        (network_bytes(*[(4, 0)] * 9), "layers of network 0 is 9"),
        (network_bytes((3, 0), (5, 0)), "network 0 has 5 outputs, expected 4"),
        (network_bytes((1 << 16, 0), (1 << 16, 0), (4, 0)), "weights, the format holds at most"),
    ],
)
def test_absurd_networks_are_refused_by_name(data: bytes, complaint: str) -> None:
    with pytest.raises(CorruptSection, match=f"entropy networks.*{complaint}"):
        decode_networks(data, "entropy networks", [(3, 4)])


def chained_bytes(channels: int, inertia: int = 3, largest: int = 5, flags: int = 2) -> bytes:
    """The section of one linear network of one input and a chain."""
    chain = np.full(channels * (channels - 1) // 2, largest, np.int32)
    halves = [np.zeros((channels, 1), np.int32)] * 2 + [np.zeros(channels, np.int32)] * 2
    fields = network_bytes((2 * channels, 0), flags=flags, inertia=inertia)
    return fields + encode_arrays([*halves, chain])


def test_chains_and_inertia_come_back() -> None:
    (network,) = decode_networks(chained_bytes(3), "entropy networks", [(1, 6)])
    assert network.rows.inertia == 3 and network.rows.chain.tolist() == [5, 5, 5]
    assert encode_networks([network]) == chained_bytes(3)
    (plain,) = decode_networks(encode_networks([replace(network, rows=RowContext())]), "x", [(1, 6)])
    assert plain.rows == RowContext()
    # With two slots of a coupled primitive the network has twice as many outputs as the group has channels.
    halves = [np.zeros((6, 1), np.int32)] * 2 + [np.zeros(6, np.int32)] * 2
    data = network_bytes((12, 0), flags=2) + encode_arrays([*halves, np.array([1, 2, 3], np.int32)])
    (of_slots,) = decode_networks(data, "entropy networks", [(1, 12)], channels=[3])
    assert of_slots.rows.chain.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("data", "version", "complaint"),
    [
        (chained_bytes(3, inertia=64), 5, "inertia is 64, expected 0 to 63"),
        (chained_bytes(3, largest=-4096), 5, "an element of the chain reaches 4096"),
        (chained_bytes(1), 5, "flags of network 0 are 2"),
        (chained_bytes(3, flags=3), 5, "flags of network 0 are 3"),
        (chained_bytes(3), 4, "flags of network 0 are 2"),
        (chained_bytes(3)[:-1], 5, "low bits|weights|words|bytes"),
    ],
)
def test_absurd_chains_and_inertia_are_refused_by_name(data: bytes, version: int, complaint: str) -> None:
    sizes = [(1, 2 if data == chained_bytes(1) else 6)]
    with pytest.raises(CorruptSection, match=f"entropy networks.*({complaint})"):
        decode_networks(data, "entropy networks", sizes, version=version)


def test_networks_that_could_be_inexact_are_refused_when_they_are_read() -> None:
    """What a file says is checked as what a program makes: 2 inputs of 2^28 leave 2^52."""
    fields = network_bytes((2, 0))
    heavy = np.full((1, 2), 1 << 28, np.int32)
    arrays = [heavy, heavy, np.zeros(1, np.int32), np.zeros(1, np.int32)]
    with pytest.raises(CorruptSection, match=r"entropy networks: layer 0: 2 inputs .* 2\^52"):
        decode_networks(fields + encode_arrays(arrays), "entropy networks", [(2, 2)])


def test_the_number_of_products_is_known_before_a_weight_is_decoded() -> None:
    """Behind the fields there is nothing to decode: whoever tried would fail otherwise."""

    class Refused(Exception):
        pass

    def refuse(products: int) -> None:
        raise Refused(products)

    fields = network_bytes((8, RECTIFY), (8, RECTIFY), (8, ADDS), (6, 0), flags=1) + network_bytes((4, 0))
    with pytest.raises(Refused) as refused:
        decode_networks(fields, "entropy networks", [(5, 6), (7, 4)], refuse)
    assert refused.value.args == (5 * 8 + 8 * 8 + 8 * 8 + (8 + 5) * 6 + 7 * 4,)
    named = b"\x02" + b"\x00\x01a\x02\x03\x05\x00" + b"\x01\x01b\x01\x04\x00"
    with pytest.raises(Refused) as refused:
        decode_heads(named, "prediction heads", refuse)
    assert refused.value.args == (3 * 5 + 4,)


def test_products_are_those_of_the_network_that_was_read() -> None:
    counted: list[int] = []
    written = [network(np.random.default_rng(0), 5, 8, 8, 8, 6, skip=True, adds=True)]
    (read,) = decode_networks(encode_networks(written), "entropy networks", [(5, 6)], counted.append)
    assert counted == [read.products] == [5 * 8 + 8 * 8 + 8 * 8 + 13 * 6]


def test_networks_beyond_the_limits_are_refused_before_anything_is_written() -> None:
    rng = np.random.default_rng(0)
    many = IntegerNetwork(
        (IntegerLayer(np.zeros((1 << 11, 1 << 11), np.int32), np.zeros(1 << 11, np.int64), 0, False),)
    )
    for written, complaint in [
        ([network(rng, *[2] * 10)], "9 layers"),
        ([network(rng, 1, (1 << 16) + 1)], "wider"),
        ([many], f"weights, the format holds at most {MAX_WEIGHTS}"),
    ]:
        with pytest.raises(NotEncodable, match=complaint):
            encode_networks(written)


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


SHAPES = {"a.weight": (3, 2), "a.bias": (2,), "none": (0, 4)}


def test_heads_that_the_scene_knows_take_no_names() -> None:
    rng = np.random.default_rng(0)
    tensors = [
        QuantizedTensor(rng.integers(-60, 60, s).astype(np.int32), e) for e, s in enumerate(SHAPES.values())
    ]
    data = encode_known_heads(tensors)
    read = decode_known_heads(data, "prediction heads", SHAPES)
    assert [name for name, _ in read] == list(SHAPES)
    for (_, a), b in zip(read, tensors, strict=True):
        assert a.exponent == b.exponent and np.array_equal(a.values, b.values)
    assert len(data) < len(encode_heads(read)) - len("a.weight" + "bias" + "none")
    for size in range(len(data)):
        with pytest.raises(CorruptSection, match="prediction heads"):
            decode_known_heads(data[:size], "prediction heads", SHAPES)
    with pytest.raises(CorruptSection, match=r"exponent of a\.weight is 63"):
        decode_known_heads(b"\x7e" + data[1:], "prediction heads", SHAPES)
    with pytest.raises(NotEncodable, match="exponent"):
        encode_known_heads([replace(tensors[0], exponent=-63)])


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
