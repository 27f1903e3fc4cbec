"""Frequency tables against high-precision arithmetic, and hyperprior tables against their own definition."""

import subprocess
import sys
import zlib
from pathlib import Path

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.codec import tables as tables_module
from compgs.codec.fields import FieldReader
from compgs.codec.sections import decode_tables, encode_tables
from compgs.codec.tables import (
    GAUSSIAN_COUNT,
    GAUSSIAN_CRC32,
    MANTISSAS,
    TOTAL,
    HyperTable,
    channel_tables,
    gaussian_tables,
    hyper_tables,
)
from compgs.errors import CorruptSection

TABLES_FILE = Path(tables_module.__file__).with_name("gaussian_tables.bin")


def gaussian_frequencies(i: int) -> dict[int | str, int]:
    """Frequencies of table i by symbol, straight from the rule in docs/bitstream.md."""
    with mpmath.workdps(40):
        sigma = mpmath.mpf(2) ** (mpmath.mpf(i) / 12 - 5)
        radius = int(mpmath.ceil(5 * sigma)) + 1
        edges = [mpmath.ncdf(-(mpmath.mpf(q) - 0.5), 0, sigma) for q in range(1, radius + 2)]
        escape = max(1, int(mpmath.floor(2 * edges[-1] * TOTAL + 0.5)))
        found: dict[int | str, int] = {"escape": escape}
        for q in range(1, radius + 1):
            found[q] = found[-q] = max(1, int(mpmath.floor((edges[q - 1] - edges[q]) * TOTAL + 0.5)))
        found[0] = TOTAL - sum(found.values())
    return found


def test_gaussian_tables_are_those_of_high_precision_arithmetic() -> None:
    tables = gaussian_tables()
    assert len(tables) == GAUSSIAN_COUNT
    for i in range(GAUSSIAN_COUNT):
        expected = gaussian_frequencies(i)
        start, count, lowest = tables.offsets[i], int(tables.counts[i]), int(tables.lowest[i])
        widths = np.diff(tables.cumulative[start : start + count + 2].astype(np.int64))
        found = {lowest + j: int(widths[j]) for j in range(count)} | {"escape": int(widths[count])}
        assert found == expected, f"table {i}"


def test_gaussian_tables_file_has_the_pinned_checksum() -> None:
    assert zlib.crc32(TABLES_FILE.read_bytes()) == GAUSSIAN_CRC32


def test_lookup_starts_the_search_at_or_before_every_slots_symbol() -> None:
    tables = gaussian_tables()
    for i in range(0, GAUSSIAN_COUNT, 9):
        start, count = tables.offsets[i], tables.counts[i]
        edges = tables.cumulative[start : start + count + 2].astype(np.int64)
        slots = np.arange(TOTAL)
        owner = np.searchsorted(edges, slots, side="right") - 1
        begin = tables.lookup[i][slots >> 8]
        assert (begin <= owner).all()
        assert (begin == owner[slots & ~255]).all()


def test_mantissas_are_eighths_of_an_octave() -> None:
    with mpmath.workdps(30):
        assert (
            tuple(int(mpmath.floor(mpmath.mpf(2) ** (10 + mpmath.mpf(m) / 8))) for m in range(8)) == MANTISSAS
        )


@given(st.lists(st.integers(0, 127), min_size=2, max_size=1025), st.integers(-(1 << 18), 1 << 18))
@settings(max_examples=60, deadline=None)
def test_hyper_frequencies_are_positive_and_sum_to_the_total(levels: list[int], lowest: int) -> None:
    table = HyperTable(lowest, np.array(levels, np.uint8))
    frequencies = table.frequencies()
    assert frequencies.min() >= 1
    assert int(frequencies.sum()) == TOTAL
    weights = [MANTISSAS[level % 8] << (level // 8) for level in levels]
    exact = [1 + w * (TOTAL - len(levels)) // sum(weights) for w in weights]
    exact[levels.index(max(levels))] += TOTAL - sum(exact)
    assert frequencies.tolist() == exact


@given(st.lists(st.lists(st.integers(0, 127), min_size=2, max_size=60), min_size=1, max_size=14), st.data())
@settings(max_examples=40, deadline=None)
def test_hyper_tables_come_back_from_their_section(rows: list[list[int]], data: st.DataObject) -> None:
    written = tuple(
        HyperTable(data.draw(st.integers(-(1 << 18), 1 << 18)), np.array(levels, np.uint8)) for levels in rows
    )
    read = decode_tables(encode_tables(written), "hyperprior tables", len(written))
    assert [t.lowest for t in read] == [t.lowest for t in written]
    assert all((a.levels == b.levels).all() for a, b in zip(read, written, strict=True))


def test_hyper_tables_cost_little_more_than_the_symbols_own_entropy() -> None:
    rng = np.random.default_rng(3)
    symbols = np.rint(rng.standard_normal((20_000, 5)) * [0.3, 1.0, 3.0, 10.0, 40.0]).astype(np.int32)
    tables = hyper_tables(np.full((5, 49), 1 / 49), symbols)
    laid_out = channel_tables(tables)
    costs = laid_out.costs()
    for c in range(5):
        _, counts = np.unique(symbols[:, c], return_counts=True)
        entropy = float(-(counts * np.log2(counts / counts.sum())).sum())
        j = symbols[:, c] - tables[c].lowest
        assert (j >= 0).all() and (j < len(tables[c].levels) - 1).all()
        assert costs[laid_out.offsets[c] + j].sum() < entropy * 1.002 + 8


def test_hyper_tables_follow_the_learned_density_where_symbols_are_few() -> None:
    density = np.array([[0.05, 0.1, 0.7, 0.1, 0.05]])
    (table,) = hyper_tables(density, np.array([[-2], [2]], np.int32))
    frequencies = table.frequencies()
    assert table.lowest == -2 and len(frequencies) == 6
    assert frequencies[2] > frequencies[1] > 1


@pytest.mark.parametrize("data", [b"", b"\x02\x00", b"\x01\x00\x00\x00\x00", b"\x82\x80\x00\x00"])
def test_broken_hyper_tables_are_refused_by_name(data: bytes) -> None:
    with pytest.raises(CorruptSection, match="hyperprior tables"):
        decode_tables(data, "hyperprior tables", 1)


def test_varints_have_one_spelling() -> None:
    with pytest.raises(CorruptSection, match="needless"):
        FieldReader(b"\x80\x00", "x").varint("n", 0, 10)


def test_the_codec_needs_no_torch() -> None:
    code = (
        "import sys, compgs.codec.writer, compgs.codec.reader, compgs.codec.rans; "
        "assert not any(m == 'torch' or m.startswith('torch.') for m in sys.modules), 'torch was imported'"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
