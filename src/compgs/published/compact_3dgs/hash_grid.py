"""A multiresolution hash grid (Müller et al., Instant-NGP, 2022): features of places in the unit cube. Free of torch.

Level l divides the cube into floor(base x growth^l) cells an axis. Each of its nodes has an entry of features; where
there are more nodes than a table may have entries, several share one, by a hash of their coordinates. A place gets the
features of the eight nodes around it, weighted trilinearly; those of all levels stand side by side.
"""

import math
from dataclasses import dataclass

import numpy as np

from compgs.numerics.compiled import chunk_of, njit

PRIMES = (1, 2_654_435_761, 805_459_861)  # of the published hash


@dataclass(frozen=True)
class GridLayout:
    """How many entries each level has, and where in the array of all of them."""

    levels: int
    features: int  # of an entry
    base: int  # cells an axis of the coarsest level
    growth: float  # of the cells an axis, from level to level
    table_bits: int  # log2 of the entries that a level may have

    @property
    def cells(self) -> np.ndarray:
        """[levels] int64, an axis."""
        return np.array([math.floor(self.base * self.growth**level) for level in range(self.levels)])

    @property
    def entries(self) -> np.ndarray:
        """[levels] int64"""
        return np.minimum((self.cells + 1) ** 3, 1 << self.table_bits)

    @property
    def offsets(self) -> np.ndarray:
        """[levels] int64: each level's first entry."""
        return np.cumsum(self.entries) - self.entries

    @property
    def total(self) -> int:
        """Entries of all levels."""
        return int(self.entries.sum())

    @property
    def width(self) -> int:
        """Numbers of a place."""
        return self.levels * self.features


def grid_features(
    places: np.ndarray,  # [V, 3] float32, 0 to 1
    grid: np.ndarray,  # [entries of all levels, F] float32
    layout: GridLayout,
) -> np.ndarray:  # [V, levels x F] float32
    """Features of places."""
    found = np.empty((len(places), layout.width), np.float32)
    _features(np.ascontiguousarray(places), grid, layout.cells, layout.entries, layout.offsets, found)
    return found


def grid_gradient(places: np.ndarray, d_features: np.ndarray, layout: GridLayout) -> np.ndarray:
    """[entries of all levels, F]: gradient by the grid, of a number whose gradient by the features is `d_features`."""
    d_grid = np.zeros((layout.total, layout.features), np.float32)
    arrays = np.ascontiguousarray(places), np.ascontiguousarray(d_features)
    _gradient(*arrays, layout.cells, layout.entries, layout.offsets, d_grid)
    return d_grid


@njit(inline="always")
def _node(x, y, z, cells, entries):
    """Which entry of its level a node has."""
    side = cells + 1
    if side * side * side <= entries:
        return x + side * (y + side * z)
    return (x ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & (entries - 1)  # entries: a power of two


@njit(inline="always")
def _cell(place, cells):
    """(cell, place within it) along an axis; the cube's far side belongs to the last cell."""
    scaled = place * np.float32(cells)
    cell = min(max(np.int64(scaled), 0), cells - 1)
    return cell, scaled - np.float32(cell)


@njit(parallel=True)
def _features(places, grid, cells, entries, offsets, found, part):
    for v in chunk_of(len(places), part):
        for level in range(len(cells)):
            n, first, width = cells[level], offsets[level], grid.shape[1]
            x, fx = _cell(places[v, 0], n)
            y, fy = _cell(places[v, 1], n)
            z, fz = _cell(places[v, 2], n)
            for f in range(width):
                found[v, level * width + f] = 0
            for corner in range(8):
                i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
                row = first + _node(x + i, y + j, z + k, n, entries[level])
                for f in range(width):
                    found[v, level * width + f] += np.float32(weight) * grid[row, f]


@njit(parallel=True)
def _gradient(places, d_features, cells, entries, offsets, d_grid, part):
    """Levels are shared among threads, and have no entry in common: all sums have one order."""
    for level in chunk_of(len(cells), part):
        n, first, width = cells[level], offsets[level], d_grid.shape[1]
        for v in range(len(places)):
            x, fx = _cell(places[v, 0], n)
            y, fy = _cell(places[v, 1], n)
            z, fz = _cell(places[v, 2], n)
            for corner in range(8):
                i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
                row = first + _node(x + i, y + j, z + k, n, entries[level])
                for f in range(width):
                    d_grid[row, f] += np.float32(weight) * d_features[v, level * width + f]
