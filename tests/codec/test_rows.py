"""What symbols say about later ones of their row: against slow twins, and against what it should save."""

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from compgs.codec.content import CodedGroup
from compgs.codec.integer_network import IntegerLayer, IntegerNetwork, entropy_parameters
from compgs.codec.rans import CHUNK_SYMBOLS, decode_symbols, encode_symbols, escape_bits
from compgs.codec.reader import read_latents
from compgs.codec.row_fitting import best_inertia, with_chain, with_fitted_rows
from compgs.codec.rows import (
    CHAIN_LIMIT,
    LARGEST_TABLE_SHIFT,
    MAX_INERTIA,
    RowContext,
    Rows,
    chain_length,
    expected_sizes,
    followed_tables,
    shift_after,
    shift_edges,
    steps_of_rows,
    symbols_of_rows,
)
from compgs.codec.tables import gaussian_tables
from compgs.codec.writer import write_content
from compgs.errors import CorruptSection

GOLDEN = Path(__file__).parents[1] / "golden"
STEPS = st.integers(-(1 << 18), 1 << 18)


@st.composite
def rows_with_a_chain(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    channels = draw(st.integers(2, 7))
    steps = draw(hnp.arrays(np.int32, (draw(st.integers(0, 5)), channels), elements=STEPS))
    chain = draw(hnp.arrays(np.int32, chain_length(channels), elements=st.integers(-90, 90)))
    return steps, chain


@given(rows_with_a_chain())
@settings(max_examples=60, deadline=None)
def test_steps_come_back_along_a_chain_as_in_python_integers(case: tuple[np.ndarray, np.ndarray]) -> None:
    steps, chain = case
    context = RowContext(chain)
    symbols = symbols_of_rows(context, steps)
    assert np.array_equal(steps_of_rows(context, symbols), steps)
    for row, found in zip(steps.tolist(), symbols.tolist(), strict=True):
        left = iter(chain.tolist())
        for c, symbol in enumerate(found):
            expected = sum(next(left) * row[j] for j in range(c))
            assert symbol == row[c] - math.floor(Fraction(expected, 64) + Fraction(1, 2))


def test_without_a_chain_symbols_are_steps() -> None:
    steps = np.arange(12, dtype=np.int32).reshape(3, 4)
    assert (
        symbols_of_rows(RowContext(), steps) is steps and steps_of_rows(RowContext(None, 9), steps) is steps
    )


EDGES = [2 ** ((shift + 0.5) / 12) for shift in range(-36, 36)]  # between the ratios of two shifts in a row


def slow_tables(
    symbols: list[int], index: list[int], width: int, inertia: int, chunk: int = CHUNK_SYMBOLS
) -> tuple[list[int], list[bool]]:
    """docs/bitstream.md, "Rows", word by word: exact sums, and logarithms in place of a table of edges. The second list
    says where neither a table nor an earlier one of its row hung on a ratio within 2^-14 of an edge.
    """
    tables, out, surely = gaussian_tables(), [], []
    seen = expected = shift = 0
    sure = True
    for i, (symbol, t) in enumerate(zip(symbols, index, strict=True)):
        if i % width == 0 or i % chunk == 0:
            seen = expected = 4096 * inertia
            shift = 0
            sure = True
        out.append(min(max(t + shift, 0), 127))
        surely.append(sure)
        furthest = -int(tables.lowest[out[-1]])
        magnitude = abs(symbol) if abs(symbol) <= furthest else 10**6  # escaped: its value is not there yet
        start, count, lowest = int(tables.offsets[t]), int(tables.counts[t]), int(tables.lowest[t])
        edges = [int(x) for x in tables.cumulative[start : start + count + 1]]
        size = sum(q * (edges[q - lowest + 1] - edges[q - lowest]) for q in range(1, -lowest + 1)) // 8
        seen += 4096 * min(4096 * magnitude, 4 * size) // (size + 1229)
        expected += 4096 * size // (size + 1229)
        ratio = 12 * math.log2(seen / expected) if seen > 0 else -math.inf
        shift = int(min(max(math.floor(ratio + 0.5) if seen > 0 else -36, -36), 36))
        sure = sure and min(abs(seen / expected - edge) for edge in EDGES) > 2**-14
    return out, surely


@given(
    st.lists(st.tuples(st.integers(-400, 400), st.integers(0, 127)), min_size=1, max_size=60),
    st.integers(1, 9),
    st.integers(1, MAX_INERTIA),
)
@settings(max_examples=80, deadline=None)
def test_tables_follow_their_rows_as_in_exact_arithmetic(
    pairs: list[tuple[int, int]], width: int, inertia: int
) -> None:
    """But for ratios within a 2^-14th of an edge, which logarithms and the table of edges may put on either side."""
    symbols, index = (np.array(x) for x in zip(*pairs, strict=True))
    index = index.astype(np.uint8)
    kind = Rows(width, inertia)
    found = followed_tables(symbols.astype(np.int32), index, gaussian_tables(), kind, CHUNK_SYMBOLS)
    slow, surely = map(np.array, slow_tables(symbols.tolist(), index.tolist(), width, inertia))
    assert (np.abs(found.astype(int) - slow) <= 1).all()
    assert (found == slow)[surely].all()


def test_expected_sizes_are_those_of_the_normal_distribution() -> None:
    deviations = 2.0 ** (np.arange(128) / 12 - 5)
    wide = deviations > 1.5  # narrower ones are mostly rounding
    assert expected_sizes()[wide] / 4096 == pytest.approx(deviations[wide] * math.sqrt(2 / math.pi), rel=0.02)
    assert (np.diff(expected_sizes()) >= 0).all() and expected_sizes()[0] < 4096 * 0.001


def test_edges_lie_halfway_between_two_tables() -> None:
    d = np.arange(-LARGEST_TABLE_SHIFT, LARGEST_TABLE_SHIFT + 1)
    assert shift_edges()[1:-1] == pytest.approx(32768 * 2 ** ((d[1:] - 0.5) / 12), abs=1)


def test_no_ratio_leads_beyond_the_largest_shift() -> None:
    assert shift_after(0, 63 << 12, 0, shift_edges()) == -LARGEST_TABLE_SHIFT
    assert shift_after(1 << 24, 1 << 12, 0, shift_edges()) == LARGEST_TABLE_SHIFT


def gaussian_rows(
    rows: int, width: int, seed: int, spread: float = 0.0, scales: tuple[int, int] = (30, 90)
) -> tuple[np.ndarray, np.ndarray]:
    """[rows, width] symbols and tables; `spread`: octaves by which rows are larger or smaller together."""
    rng = np.random.default_rng(seed)
    index = rng.integers(*scales, (rows, width)).astype(np.uint8)
    factor = 2.0 ** (rng.standard_normal((rows, 1)) * spread)
    symbols = np.rint(rng.standard_normal((rows, width)) * 2.0 ** (index / 12 - 5) * factor)
    return symbols.astype(np.int32), index


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("rows", "width"), [(1, 1), (3, 7), (400, 32), (40_000, 9), (160_000, 7)])
def test_streams_whose_tables_follow_rows_come_back(
    rows: int, width: int, threads: int, with_threads: Callable[[int], None]
) -> None:
    """One state and two, rows that go on in the next chunk, escapes."""
    symbols, index = gaussian_rows(rows, width, 1, spread=0.8)
    symbols[:: max(1, rows // 5)] *= 1000
    symbols, index = symbols.ravel(), index.ravel()
    kind = Rows(width, 7)
    with_threads(threads)
    data = encode_symbols(symbols, index, gaussian_tables(), kind)
    kept = index.copy()
    assert np.array_equal(decode_symbols(data, index, gaussian_tables(), rows=kind), symbols)
    assert np.array_equal(index, kept), "the tables that were given have changed"
    bits = sum(escape_bits(symbols, index, gaussian_tables(), kind))
    assert 8 * len(data) == pytest.approx(bits, rel=0.001, abs=200)


def test_damaged_streams_of_rows_are_refused_or_decode_to_other_symbols() -> None:
    symbols, index = (x.ravel() for x in gaussian_rows(200, 8, 2, spread=1.0))
    kind, rng = Rows(8, 5), np.random.default_rng(0)
    data = encode_symbols(symbols, index, gaussian_tables(), kind)
    refused = 0
    for _ in range(200):
        forged = bytearray(data)
        forged[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        try:
            assert not np.array_equal(
                decode_symbols(bytes(forged), index, gaussian_tables(), rows=kind), symbols
            )
        except CorruptSection:
            refused += 1
    assert refused > 190  # the last state proves nearly every bit


def network_of(index: np.ndarray) -> IntegerNetwork:
    """That gives every row the mean tables of the channels, and means of zero."""
    channels = index.shape[1]
    bias = np.concatenate([np.zeros(channels), np.rint(index.mean(0) * 4096)]).astype(np.int64)
    return IntegerNetwork((IntegerLayer(np.zeros((2 * channels, 1), np.int32), bias, 0, False),))


def coded_of(symbols: np.ndarray, index: np.ndarray) -> CodedGroup:
    return CodedGroup(symbols, index, gaussian_tables(), symbols << 12)


def test_rows_that_are_large_or_small_together_take_fewer_bytes_with_inertia() -> None:
    """A spread of one octave is worth some 15 % here; ideal tables, which know each row's factor, would save more."""
    symbols, index = gaussian_rows(3000, 24, 3, spread=1.0)
    coded = coded_of(symbols, index)
    inertia = best_inertia(coded)
    assert 0 < inertia < 12
    assert replace(coded, inertia=inertia).bits() < 0.9 * coded.bits()


def test_rows_of_independent_symbols_get_little_inertia_or_none_and_lose_nothing() -> None:
    coded = coded_of(*gaussian_rows(3000, 24, 4))
    inertia = best_inertia(coded)
    assert inertia in (0, MAX_INERTIA)
    assert replace(coded, inertia=inertia).bits() <= coded.bits()


def correlated(rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Three channels of 6 steps' deviation, with a correlation of 0.9, and tables that think each stands alone."""
    rng = np.random.default_rng(seed)
    common = rng.standard_normal((rows, 1))
    steps = 6 * (math.sqrt(0.9) * common + math.sqrt(0.1) * rng.standard_normal((rows, 3)))
    return np.rint(steps).astype(np.int32), np.full((rows, 3), round(12 * (math.log2(6) + 5)), np.uint8)


def test_a_chain_saves_what_channels_have_in_common() -> None:
    """The closed form: half the logarithm of the determinant of their correlations, for each row."""
    steps, index = correlated(6000, 5)
    coded = coded_of(steps, index)
    network = with_chain(network_of(index), coded)
    context = network.rows
    _, tables = entropy_parameters(network, np.zeros((len(steps), 1), np.int32))
    symbols = symbols_of_rows(context, steps)
    bits = sum(escape_bits(symbols.ravel(), tables.ravel(), gaussian_tables()))
    determinant = np.linalg.det(np.full((3, 3), 0.9) + 0.1 * np.eye(3))
    saved = -0.5 * math.log2(determinant) * len(steps)
    assert coded.bits() - bits == pytest.approx(saved, rel=0.03)


def test_channels_that_have_nothing_in_common_get_no_chain() -> None:
    symbols, index = gaussian_rows(500, 6, 6)
    network = network_of(index)
    assert with_chain(network, coded_of(symbols, index)) is network
    alone = gaussian_rows(500, 1, 6)
    assert with_chain(network_of(alone[1]), coded_of(*alone)).rows.chain is None


def test_a_chain_does_not_depend_on_the_number_of_threads(with_threads: Callable[[int], None]) -> None:
    steps, index = correlated(20_000, 7)
    chains = []
    for threads in (1, 2):
        with_threads(threads)
        chains.append(with_chain(network_of(index), coded_of(steps, index)).rows.chain)
    assert chains[0] is not None and np.array_equal(chains[0], chains[1])


def test_what_the_format_cannot_hold_is_refused() -> None:
    RowContext(np.array([CHAIN_LIMIT - 1, 1 - CHAIN_LIMIT], np.int32), MAX_INERTIA)
    for wrong in (
        {"inertia": MAX_INERTIA + 1},
        {"inertia": -1},
        {"chain": np.array([0, -CHAIN_LIMIT], np.int32)},
    ):
        with pytest.raises(ValueError, match=r"inertia is|the chain reaches"):
            RowContext(**wrong)


def test_an_older_file_is_written_smaller_and_stays_the_same_scene() -> None:
    """`dilated` is of version 4. Contents must be in the file's order, as `read_latents` gives them."""
    content, latents = read_latents((GOLDEN / "dilated.cgs").read_bytes())
    data = write_content(with_fitted_rows(content))
    again, same = read_latents(data)
    assert all(np.array_equal(a, b) for a, b in zip(latents, same, strict=True))
    assert len(data) <= len(write_content(content))
    assert write_content(with_fitted_rows(again)) == data, "once more changes nothing"
