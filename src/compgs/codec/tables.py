"""Frequency tables: what the entropy coder believes about a symbol, in integers (docs/bitstream.md,
"Tables").

A table gives each symbol of a contiguous range, and an escape for all others, a frequency of at least 1 in
65536. `GAUSSIAN` tables are constants of the format: zero mean, standard deviation 2^(i/12 - 5) steps for i =
0 ... 127. Hyperpriors have one table a channel (the factorized density of CompGS Sec. 3.3), made by the
encoder and stored in the file as eighths of an octave.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from compgs.errors import CompGSError

PRECISION_BITS = 16
TOTAL = 1 << PRECISION_BITS  # sum of a table's frequencies
LOOKUP_BITS = 8  # of the cumulative frequency: where the search for a symbol starts
GAUSSIAN_COUNT = 128
SCALES_PER_OCTAVE = 12
SMALLEST_SCALE_OCTAVE = -5  # table 0: 2^-5 quantization steps
GAUSSIAN_CRC32 = 0xAD3B4090  # of gaussian_tables.bin; tools/make_gaussian_tables.py makes it

LEVELS = 128  # levels of a hyperprior's table: eighths of an octave
MAX_HYPER_SYMBOLS = 1024  # in one channel's table, without the escape
MAX_TABLES = 256  # of a group: a table's number is a byte
MAX_LOWEST = 1 << 18  # absolute value of a table's lowest symbol
# floor(2^(10 + m/8)), m = 0 ... 7
MANTISSAS = (1024, 1116, 1217, 1327, 1448, 1579, 1722, 1878)
# Occurrences that the learned density counts for beside the symbols' own histogram.
PRIOR_WEIGHT = 4.0


@dataclass(frozen=True)
class FrequencyTables:
    """T tables laid out for the coder. Symbols of table t are lowest[t] ... lowest[t] + counts[t] - 1, then
    escape.
    """

    lowest: np.ndarray  # [T] int32
    counts: np.ndarray  # [T] int32, without the escape
    offsets: np.ndarray  # [T] int32 into cumulative
    cumulative: np.ndarray  # uint32, counts[t] + 2 entries a table, from 0 to 65536
    lookup: np.ndarray  # [T, 256] uint16: symbol that contains the first of 256 consecutive slots

    def __len__(self) -> int:
        return len(self.lowest)

    def costs(self) -> np.ndarray:
        """Bits of each symbol, laid out like `cumulative`."""
        widths = np.diff(self.cumulative.astype(np.int64), append=TOTAL)
        widths[self.offsets + self.counts + 1] = 1  # a table's last entry has no symbol
        return PRECISION_BITS - np.log2(widths)


def frequency_tables(lowest: Sequence[int], frequencies: Sequence[np.ndarray]) -> FrequencyTables:
    """Lay out tables; each row of frequencies ends with the escape, all are at least 1 and sum to 65536."""
    assert 0 < len(frequencies) <= 256, "a table's index must fit into a byte"
    cumulative, offsets, lookups = [], [], []
    slots = np.arange(1 << LOOKUP_BITS) << (PRECISION_BITS - LOOKUP_BITS)
    start = 0
    for row in frequencies:
        assert row.min() >= 1 and int(row.sum()) == TOTAL
        edges = np.concatenate([[0], np.cumsum(row)])
        lookups.append(np.searchsorted(edges, slots, side="right") - 1)
        cumulative.append(edges)
        offsets.append(start)
        start += len(edges)
    return FrequencyTables(
        lowest=np.array(lowest, np.int32),
        counts=np.array([len(row) - 1 for row in frequencies], np.int32),
        offsets=np.array(offsets, np.int32),
        cumulative=np.concatenate(cumulative).astype(np.uint32),
        lookup=np.array(lookups, np.uint16),
    )


@cache
def gaussian_tables() -> FrequencyTables:
    """The 128 Gaussian tables, read on first use."""
    file = Path(__file__).with_name("gaussian_tables.bin")
    data = file.read_bytes()
    if zlib.crc32(data) != GAUSSIAN_CRC32:
        raise CompGSError(
            f"{file}: checksum {zlib.crc32(data):#010x}, expected {GAUSSIAN_CRC32:#010x}; reinstall compgs"
        )
    numbers = np.frombuffer(data, "<u2").astype(np.int64)
    lowest, frequencies = [], []
    at = 0
    while at < len(numbers):
        radius = int(numbers[at])
        right = numbers[at + 1 : at + 2 + radius]  # f(0) ... f(r)
        lowest.append(-radius)
        frequencies.append(np.concatenate([right[:0:-1], right, numbers[at + 2 + radius : at + 3 + radius]]))
        at += radius + 3
    return frequency_tables(lowest, frequencies)


@dataclass(frozen=True)
class HyperTable:
    """One hyperprior channel's table as the file holds it: level L stands for a weight of 2^(L/8)."""

    lowest: int  # symbol of the first level
    levels: np.ndarray  # [symbols + 1] uint8 below 128, the last for the escape

    def frequencies(self) -> np.ndarray:
        """[symbols + 1] int64, each at least 1, sum 65536: every symbol gets 1, the rest goes by weight."""
        levels = self.levels.astype(np.int64)
        weights = np.array(MANTISSAS, np.int64)[levels & 7] << (levels >> 3)
        frequencies = 1 + weights * (TOTAL - len(levels)) // int(weights.sum())
        frequencies[int(np.argmax(levels))] += TOTAL - int(frequencies.sum())
        return frequencies


def channel_tables(tables: Sequence[HyperTable]) -> FrequencyTables:
    """One table a channel, for the coder."""
    return frequency_tables([t.lowest for t in tables], [t.frequencies() for t in tables])


def hyper_tables(
    probabilities: np.ndarray,  # [C, 2 R + 1] the learned density of symbols -R ... R
    symbols: np.ndarray,  # [N, C] the symbols that will be coded
) -> tuple[HyperTable, ...]:
    """Tables for a hyperprior's C channels: the symbols' own histogram, smoothed by the learned density.

    The file holds the table anyway, so it may as well be the one that suits the file's symbols. Symbols
    beyond the widest table, 1024 around the channel's median, are escaped.
    """
    reach = probabilities.shape[1] // 2
    tables = []
    for density, column in zip(probabilities, symbols.T, strict=True):
        middle = int(np.median(column))
        half = MAX_HYPER_SYMBOLS // 2
        inside = column[(column >= middle - half) & (column < middle + half)]
        lowest, highest = int(inside.min()), int(inside.max())
        lowest = min(max(lowest, -MAX_LOWEST), MAX_LOWEST)
        inside = inside[inside >= lowest]
        weights = np.bincount(inside - lowest, minlength=max(highest - lowest, 0) + 1).astype(np.float64)
        first, last = max(lowest, -reach), min(highest, reach)
        if first <= last:
            weights[first - lowest : last - lowest + 1] += (
                PRIOR_WEIGHT * density[first + reach : last + reach + 1]
            )
        weights = np.append(weights, len(column) - len(inside))
        octaves = np.log2(np.maximum(weights, 1e-30) / weights.max())
        levels = np.clip(np.rint(8.0 * octaves) + LEVELS - 1, 0, LEVELS - 1)
        tables.append(HyperTable(lowest, levels.astype(np.uint8)))
    return tuple(tables)
