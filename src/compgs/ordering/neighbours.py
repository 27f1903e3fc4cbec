"""Which anchors came before around an anchor, and how much each of them counts (docs/bitstream.md, "Neighbours").

The anchors of the ranges before are one for each occupied node of the octree level L at which these end. Around an
anchor of a range are those whose nodes differ from its own by at most one in each axis: at least one, that of its own
node, at most 27. No search for the nearest is needed, and on captures the eight nearest say no more than these.
"""

import secrets
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgs.numerics.compiled import chunk_of, njit, rows_a_thread

# What a network takes of an anchor's neighbours, before what its means follow: known, activity.
BESIDES = 2
AROUND = 27  # nodes, the own one among them
NEAREST_WEIGHT = 1 << 24  # of a neighbour at distance 1; others have less in proportion, and at least 1


@dataclass(frozen=True)
class Neighbours:
    """Holds the neighbours of a range's n anchors among the M of the ranges before. Anchors of a node share them."""

    node: NDArray[np.int32]  # [n] the anchor that represents their node
    around: NDArray[
        np.int32
    ]  # [M, AROUND] neighbours of all of the range in its node, if any; -1: there is none

    def weights(
        self, offsets: NDArray[np.int32]
    ) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
        """Where each anchor's neighbours begin among those of all [n + 1]; these [E]; and their weights [E].

        offsets: [N, 3] of all anchors up to the end of the range, in canonical order.
        """
        listed = self.around[self.node]
        anchor, place = np.nonzero(listed >= 0)
        neighbour = listed[anchor, place]
        own = offsets[len(self.around) :].astype(np.int64)
        distance = np.abs(own[anchor] - offsets[neighbour]).sum(1)
        first = np.zeros(len(self.node) + 1, np.int64)
        np.cumsum(np.bincount(anchor, minlength=len(self.node)), out=first[1:])
        return first, neighbour, 1 + NEAREST_WEIGHT // distance


def find_neighbours(offsets: NDArray[np.int32], known: int, shift: int) -> Neighbours:
    """Those of the anchors from number `known` on, among the ones before, of which there is at least one.

    offsets: [N, 3] in canonical order, up to the end of the range; shift: octree levels below that of the nodes.
    """
    bits = max(1, int(2 * known - 1).bit_length())
    table = np.full(1 << bits, -1, np.int32)
    # Drawn anew each time: nobody can write a file all of whose nodes are looked for in one place.
    factors = np.array([secrets.randbits(64) | 1 for _ in range(3)], np.uint64)
    _enter(offsets[:known], shift, table, factors)
    node = np.empty(len(offsets) - known, np.int32)
    _look_up(offsets, known, shift, table, factors, node)
    holds_some = np.zeros(known, np.bool_)
    holds_some[node] = True
    around = np.full((known, AROUND), -1, np.int32)
    _look_around(offsets, holds_some, shift, table, factors, around)
    return Neighbours(node, around)


@njit(inline="always")
def _place(x, y, z, factors, mask):
    """Where a node's entry is looked for first: its highest bits depend on all those of the node."""
    h = np.uint64(x) * factors[0] + np.uint64(y) * factors[1] + np.uint64(z) * factors[2]
    return np.int64((h >> np.uint64(32)) & np.uint64(mask))


@njit
def _find(offsets, shift, table, factors, x, y, z):
    """The anchor that represents node x, y, z; -1 if there is none."""
    mask = len(table) - 1
    at = _place(x, y, z, factors, mask)
    while table[at] >= 0:
        j = table[at]
        if offsets[j, 0] >> shift == x and offsets[j, 1] >> shift == y and offsets[j, 2] >> shift == z:
            return j
        at = (at + 1) & mask
    return -1


@njit
def _enter(offsets, shift, table, factors):
    mask = len(table) - 1
    for j in range(len(offsets)):
        at = _place(offsets[j, 0] >> shift, offsets[j, 1] >> shift, offsets[j, 2] >> shift, factors, mask)
        while table[at] >= 0:
            at = (at + 1) & mask
        table[at] = j


@njit(parallel=True, max_threads=rows_a_thread(512))
def _look_around(offsets, holds_some, shift, table, factors, around, part):
    for j in chunk_of(len(holds_some), part):
        if not holds_some[j]:
            continue
        x, y, z = offsets[j, 0] >> shift, offsets[j, 1] >> shift, offsets[j, 2] >> shift
        place = 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    around[j, place] = _find(offsets, shift, table, factors, x + dx, y + dy, z + dz)
                    place += 1


@njit(parallel=True, max_threads=rows_a_thread(512))
def _look_up(offsets, known, shift, table, factors, node, part):
    for i in chunk_of(len(node), part):
        a = known + i
        x, y, z = offsets[a, 0] >> shift, offsets[a, 1] >> shift, offsets[a, 2] >> shift
        node[i] = _find(offsets, shift, table, factors, x, y, z)
