"""The entropy coder: round trips, rate, robustness, independence of threads."""

from collections.abc import Callable

import constriction
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.codec.rans import (
    CHUNK_SYMBOLS,
    SINGLE_STATE_SYMBOLS,
    decode_symbols,
    encode_symbols,
    escape_bits,
)
from compgs.codec.tables import FrequencyTables, frequency_tables, gaussian_tables
from compgs.errors import CorruptSection


def gaussian_symbols(
    count: int, seed: int, lowest: int = 20, highest: int = 110
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    index = rng.integers(lowest, highest, count).astype(np.uint8)
    return np.rint(rng.standard_normal(count) * 2.0 ** (index / 12 - 5)).astype(np.int32), index


def python_decode(data: bytes, index: np.ndarray, tables: FrequencyTables) -> list[int]:
    """Slow twin for one chunk with one state, in Python integers, from docs/bitstream.md alone."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    word_count, escape_size = varint(), varint()
    words = [int.from_bytes(data[at + 4 * i : at + 4 * i + 4], "little") for i in range(word_count)]
    at += 4 * word_count
    assert len(data) == at + escape_size
    state = words[0] | words[1] << 32
    used = 2
    out = []
    for t in index:
        start, count, lowest = int(tables.offsets[t]), int(tables.counts[t]), int(tables.lowest[t])
        edges = [int(c) for c in tables.cumulative[start : start + count + 2]]
        slot = state & 0xFFFF
        j = next(j for j in range(count + 1) if edges[j] <= slot < edges[j + 1])
        state = (edges[j + 1] - edges[j]) * (state >> 16) + slot - edges[j]
        if state < 1 << 31:
            state = state << 32 | words[used]
            used += 1
        if j < count:
            out.append(lowest + j)
            continue
        out.append(None)
    assert state == 1 << 31 and used == word_count
    for i, symbol in enumerate(out):
        if symbol is None:
            v = varint()
            lowest, count = int(tables.lowest[index[i]]), int(tables.counts[index[i]])
            out[i] = lowest - 1 - v // 2 if v % 2 else lowest + count + v // 2
    assert at == len(data)
    return out


@given(st.lists(st.tuples(st.integers(-(1 << 31), (1 << 31) - 1), st.integers(0, 127)), max_size=60))
@settings(max_examples=80, deadline=None)
def test_any_symbols_come_back_under_any_tables(pairs: list[tuple[int, int]]) -> None:
    symbols = np.array([s for s, _ in pairs], np.int32)
    index = np.array([t for _, t in pairs], np.uint8)
    data = encode_symbols(symbols, index, gaussian_tables())
    assert (decode_symbols(data, index, gaussian_tables()) == symbols).all()


@given(st.integers(1, 400), st.integers(0, 1 << 30), st.floats(0.1, 30))
@settings(max_examples=25, deadline=None)
def test_a_decoder_written_from_the_specification_agrees(count: int, seed: int, widen: float) -> None:
    symbols, index = gaussian_symbols(count, seed)
    symbols = np.rint(symbols * widen).astype(np.int32)
    data = encode_symbols(symbols, index, gaussian_tables())
    assert python_decode(data, index, gaussian_tables()) == symbols.tolist()


@pytest.mark.parametrize(
    "count", [SINGLE_STATE_SYMBOLS - 1, SINGLE_STATE_SYMBOLS, CHUNK_SYMBOLS, CHUNK_SYMBOLS + 1]
)
def test_symbols_come_back_around_the_chunk_sizes(count: int) -> None:
    symbols, index = gaussian_symbols(count, 1)
    symbols[::50_001] = 1 << 20
    symbols[-1] = -(1 << 31)
    data = encode_symbols(symbols, index, gaussian_tables())
    assert (decode_symbols(data, index, gaussian_tables()) == symbols).all()


def test_tables_of_their_own_work_like_the_gaussian_ones() -> None:
    rows = [np.array([1, 65534, 1]), np.array([65535, 1]), np.arange(1, 362)]
    rows[2][-1] += 65536 - rows[2].sum()
    tables = frequency_tables([5, -9, -(1 << 18)], rows)
    rng = np.random.default_rng(0)
    index = rng.integers(0, 3, 5000).astype(np.uint8)
    symbols = (np.array([5, -9, -(1 << 18)])[index] + rng.integers(-2, 400, 5000)).astype(np.int32)
    assert (decode_symbols(encode_symbols(symbols, index, tables), index, tables) == symbols).all()


def test_no_symbols_take_no_bytes() -> None:
    empty = np.zeros(0, np.int32)
    assert encode_symbols(empty, empty.astype(np.uint8), gaussian_tables()) == b""
    assert len(decode_symbols(b"", empty.astype(np.uint8), gaussian_tables())) == 0
    with pytest.raises(CorruptSection):
        decode_symbols(b"\0", empty.astype(np.uint8), gaussian_tables())


@pytest.mark.parametrize("count", [60_000, 300_000, 2_500_000])
def test_bytes_are_within_a_thousandth_of_the_cross_entropy(count: int) -> None:
    symbols, index = gaussian_symbols(count, 2)
    bits, escaped = escape_bits(symbols, index, gaussian_tables())
    assert len(encode_symbols(symbols, index, gaussian_tables())) * 8 < (bits + escaped) * 1.001


def test_rate_is_within_two_thousandths_of_constrictions_exact_gaussians() -> None:
    symbols, index = gaussian_symbols(200_000, 4)
    model = constriction.stream.model.QuantizedGaussian(-1000, 1000)
    coder = constriction.stream.stack.AnsCoder()
    coder.encode_reverse(symbols, model, np.zeros(len(symbols)), 2.0 ** (index / 12 - 5))
    ours = 8 * len(encode_symbols(symbols, index, gaussian_tables()))
    assert ours < coder.num_bits() * 1.002


def test_results_do_not_depend_on_the_number_of_threads(with_threads: Callable[[int], None]) -> None:
    symbols, index = gaussian_symbols(2 * CHUNK_SYMBOLS + 17, 5)
    symbols[::100_003] = 1 << 19
    results = []
    for threads in (1, 2):
        with_threads(threads)
        data = encode_symbols(symbols, index, gaussian_tables())
        results.append((data, decode_symbols(data, index, gaussian_tables()).tobytes()))
    assert all(r == results[0] for r in results)
    assert results[0][1] == symbols.tobytes()


@given(st.binary(max_size=200), st.integers(1, 3000))
@settings(max_examples=100, deadline=None)
def test_random_bytes_are_refused(data: bytes, count: int) -> None:
    with pytest.raises(CorruptSection, match="my section"):
        decode_symbols(data, np.full(count, 70, np.uint8), gaussian_tables(), "my section")


@pytest.mark.parametrize("count", [1000, SINGLE_STATE_SYMBOLS + 5])
def test_altered_streams_are_refused_or_differ_but_never_crash(count: int) -> None:
    symbols, index = gaussian_symbols(count, 6)
    symbols[::97] = 5000
    data = encode_symbols(symbols, index, gaussian_tables())
    rng = np.random.default_rng(7)
    refused = 0
    for _ in range(60):
        broken = bytearray(data)
        broken[rng.integers(len(data))] ^= 1 << rng.integers(8)
        try:
            decode_symbols(bytes(broken), index, gaussian_tables())
        except CorruptSection:
            refused += 1
    assert refused > 0
    for size in (0, 1, 5, len(data) // 2, len(data) - 1):
        with pytest.raises(CorruptSection):
            decode_symbols(data[:size], index, gaussian_tables())
    with pytest.raises(CorruptSection):
        decode_symbols(data + b"\0", index, gaussian_tables())
    with pytest.raises(CorruptSection):
        decode_symbols(data, index[:-1], gaussian_tables())
