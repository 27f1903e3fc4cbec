"""What the symbols of a row say about its later ones (docs/bitstream.md, "Rows"): a pair of encode and decode each.

A row is an anchor's symbols of a group, or those of a coupled primitive. They are large or small together: with
*inertia*, the tables of a row follow what its symbols have shown so far, and the inertia is for how many symbols'
worth of evidence the network's expectation counts. They may also predict one another: with a *chain*, a symbol is what
is left of its step when the steps before it have said what they expect.

Nothing here depends on another row, so that anchors may go without any other being touched.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from compgs.codec.tables import GAUSSIAN_COUNT, SCALES_PER_OCTAVE, FrequencyTables, gaussian_tables
from compgs.numerics.compiled import chunk_of, njit, rows_a_thread

CHAIN_BITS = (
    6  # elements of a chain are in units of 2^-6: finer ones move no step of the files that were tried
)
CHAIN_LIMIT = 1 << 12  # of an element: 64 steps for one
MAX_INERTIA = 63
SIZE_OFFSET = 1229  # Q12, 0.3: symbols whose size is expected to be far below say little, whatever they are
SIZE_CAP = 4  # expected sizes that one symbol can count for: one that is far out must not speak for all
LARGEST_TABLE_SHIFT = 36  # three octaves
# What an escaped symbol counts as, whose value a decoder does not have yet: beyond every cap.
FAR = 1 << 18
_EDGE_BITS = 15


@dataclass(frozen=True)
class RowContext:
    """Describes how rows of a network's group adapt. Raises ValueError for what the format cannot hold."""

    chain: np.ndarray | None = None  # [C (C - 1) / 2] int32, row by row of a triangle, in units of 2^-6
    inertia: int = 0  # 0: tables are as the network gives them

    def __post_init__(self) -> None:
        if not 0 <= self.inertia <= MAX_INERTIA:
            raise ValueError(f"inertia is {self.inertia}, expected 0 to {MAX_INERTIA}")
        if self.chain is not None and int(np.abs(self.chain.astype(np.int64)).max(initial=0)) >= CHAIN_LIMIT:
            raise ValueError(f"an element of the chain reaches {CHAIN_LIMIT}")


NOTHING = RowContext()


@dataclass(frozen=True)
class Rows:
    """How a stream is made of rows."""

    width: int = 1  # symbols of a row
    inertia: int = 0


def chain_length(channels: int) -> int:
    """Elements of a chain."""
    return channels * (channels - 1) // 2


def steps_of_rows(context: RowContext, symbols: np.ndarray) -> np.ndarray:  # [n, C] int32
    """Whole steps between latents and means, from symbols."""
    return symbols if context.chain is None else _along_chain(context.chain, symbols, 1)


def symbols_of_rows(context: RowContext, steps: np.ndarray) -> np.ndarray:  # [n, C] int32
    """Inverse of `steps_of_rows`."""
    return steps if context.chain is None else _along_chain(context.chain, steps, -1)


def _along_chain(chain: np.ndarray, given: np.ndarray, sign: int) -> np.ndarray:
    out = np.empty(given.shape, np.int32)
    _follow_chain(chain.astype(np.int64), np.ascontiguousarray(given), sign, out)
    return out


@njit(parallel=True, max_threads=rows_a_thread(512))
def _follow_chain(chain, given, sign, out, part):
    """Steps from symbols (sign 1), where those before are in `out` already, or symbols from steps (-1)."""
    lowest, highest = np.int64(-(1 << 31)), np.int64((1 << 31) - 1)
    for n in chunk_of(len(given), part):
        place = 0
        for c in range(given.shape[1]):
            expected = np.int64(1 << (CHAIN_BITS - 1))
            for j in range(c):
                step = np.int64(out[n, j]) if sign > 0 else np.int64(given[n, j])
                expected += chain[place] * step
                place += 1
            # Beyond 32 bits only in files that are refused for it: `MAX_SYMBOL`.
            value = np.int64(given[n, c]) + sign * (expected >> CHAIN_BITS)
            out[n, c] = np.int32(min(max(value, lowest), highest))


@cache
def expected_sizes() -> np.ndarray:  # [GAUSSIAN_COUNT] int64, Q12
    """Mean absolute value of a symbol of each Gaussian table."""
    tables, sizes = gaussian_tables(), []
    for lowest, count, offset in zip(tables.lowest, tables.counts, tables.offsets, strict=True):
        frequencies = np.diff(tables.cumulative[offset : offset + count + 1].astype(np.int64))
        positive = frequencies[1 - int(lowest) :]  # of 1 ... r; those of -r ... -1 are the same
        sizes.append(int((np.arange(1, len(positive) + 1) * positive).sum()) >> 3)
    return np.array(sizes, np.int64)


class Evidence(NamedTuple):
    """What symbols of each table count for."""

    first: np.ndarray  # [GAUSSIAN_COUNT + 1] int64 into `seen`
    seen: np.ndarray  # int64: of absolute values 0, 1, ... up to the first that is capped
    expected: np.ndarray  # [GAUSSIAN_COUNT] int64


@cache
def evidence() -> Evidence:
    """Look the evidence up in tables: a division for each symbol would take longer than to decode it."""
    first, seen, expected = [0], [], []
    for size in expected_sizes().tolist():
        capped = -(-SIZE_CAP * size >> 12)
        for magnitude in range(capped + 1):
            seen.append((min(magnitude << 12, SIZE_CAP * size) << 12) // (size + SIZE_OFFSET))
        first.append(len(seen))
        expected.append((size << 12) // (size + SIZE_OFFSET))
    return Evidence(np.array(first, np.int64), np.array(seen, np.int64), np.array(expected, np.int64))


@cache
def shift_edges() -> np.ndarray:  # [2 LARGEST_TABLE_SHIFT + 2] int64
    """Return for each shift, from the lowest on, from which ratio of sizes on it holds, seen to expected, in 2^-15.
    Below the lowest and above the highest nothing lies.
    """
    twice = 2 * SCALES_PER_OCTAVE
    shifts = range(-LARGEST_TABLE_SHIFT, LARGEST_TABLE_SHIFT + 1)
    edges = [_root(1 << (twice * _EDGE_BITS + 2 * d - 1), twice) for d in shifts]
    return np.array([0, *edges[1:], 1 << 32], np.int64)


def _root(x: int, degree: int) -> int:
    """The largest integer whose power of that degree is at most x."""
    low, high = 0, 1 << (x.bit_length() // degree + 1)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if middle**degree <= x else (low, middle - 1)
    return low


def followed_tables(
    symbols: np.ndarray,  # [M] int32
    index: np.ndarray,  # [M] uint8, as the network gives them
    tables: FrequencyTables,
    rows: Rows,
    chunk: int,  # symbols of a chunk, at whose beginning nothing is known of a row
) -> np.ndarray:  # [M] uint8
    """Tables of a stream's symbols, with inertia."""
    out = np.empty(len(index), np.uint8)
    ends = tables.lowest, tables.counts
    _follow_rows(symbols, index, *ends, rows.width, rows.inertia, chunk, evidence(), shift_edges(), out)
    return out


@njit(inline="always")
def seen_after(seen, expected, known, table, symbol):
    """(seen, expected) after a symbol, given its table as the network gives it."""
    at = np.uint64(table)
    place = np.uint64(min(known.first[at] + abs(np.int64(symbol)), known.first[at + np.uint64(1)] - 1))
    return seen + known.seen[place], expected + known.expected[at]


@njit(inline="always")
def shift_after(seen, expected, shift, edges):
    """The shift of tables, found from the one before it."""
    ratio = seen << _EDGE_BITS
    at = np.uint64(shift + LARGEST_TABLE_SHIFT)
    # One step without a branch, as nobody can foretell it; further ones are rare.
    up, down = ratio >= expected * edges[at + np.uint64(1)], ratio < expected * edges[at]
    shift += np.int64(up) - np.int64(down)
    while ratio >= expected * edges[np.uint64(shift + LARGEST_TABLE_SHIFT + 1)]:
        shift += 1
    while ratio < expected * edges[np.uint64(shift + LARGEST_TABLE_SHIFT)]:
        shift -= 1
    return shift


@njit(inline="always")
def shifted(table, shift):
    """A table, moved."""
    return min(max(np.int64(table) + shift, np.int64(0)), np.int64(GAUSSIAN_COUNT - 1))


@njit
def _follow_rows(symbols, index, lowest, counts, width, inertia, chunk, known, edges, out):
    start = np.int64(inertia) << 12
    seen, expected, shift = start, start, np.int64(0)
    for i in range(len(symbols)):
        if i % width == 0 or i % chunk == 0:
            seen, expected, shift = start, start, np.int64(0)
        t = shifted(index[i], shift)
        out[i] = np.uint8(t)
        place = np.int64(symbols[i]) - np.int64(lowest[t])
        symbol = np.int64(symbols[i]) if 0 <= place < counts[t] else np.int64(FAR)
        seen, expected = seen_after(seen, expected, known, np.int64(index[i]), symbol)
        shift = shift_after(seen, expected, shift, edges)
