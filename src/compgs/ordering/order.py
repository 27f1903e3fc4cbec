"""The canonical order of anchors: coarse to fine, so that a prefix of the file is a coarse scene.

The octree of the positions starts at `origin` (a multiple of 16 voxels, so that anchors grown on coarser
grids stay aligned with its nodes) and has `depth` levels; level 0 is the root, level `depth` the voxels. A
Morton code interleaves the bits of an anchor's coordinates, x first: the 3 top bits name its node on level 1,
the next 3 on level 2, and so on.

Of all anchors in a node, the first in Morton order represents it. The level of an anchor is the coarsest
level on which it represents a node. Sorted by (level, Morton code), the first `level_counts(...)[l]` anchors
are exactly one for each occupied node of level l. Both sides compute this from the positions alone.
"""

import numpy as np
from numpy.typing import NDArray

from compgs.errors import NotEncodable

MAXIMUM_DEPTH = 21  # bits per axis of (coordinate - origin): three of them fit a 63-bit Morton code
ALIGNMENT_BITS = 4  # the origin is a multiple of 2**4 voxels

# Rounds that spread 21 bits to every third place, or gather them: (shift, bits that stay).
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def octree_origin(coordinates: NDArray[np.int32] | NDArray[np.int64]) -> NDArray[np.int64]:
    """[3] componentwise minimum, floored to the alignment. [N, 3] with N >= 1."""
    # An axis at a time: along rows of three numbers a minimum takes eight times as long.
    minimum = np.array([coordinates[:, axis].min() for axis in range(3)], np.int64)
    return (minimum >> ALIGNMENT_BITS) << ALIGNMENT_BITS


def octree_depth(offsets: NDArray[np.int64]) -> int:
    """Number of levels below the root: bits of the largest offset from the origin. [N, 3], N >= 1."""
    return int(offsets.max()).bit_length()


def morton_codes(offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """[N, 3] offsets from the origin, below 2**21 -> [N] Morton codes; bit 3b + 2 is bit b of x."""
    codes = np.zeros(len(offsets), np.int64)
    for axis in range(3):
        v = offsets[:, axis].astype(np.int64)
        for shift, mask in _SPREAD:
            v = (v | (v << shift)) & mask
        codes |= v << (2 - axis)
    return codes


def inv_morton_codes(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """[N] Morton codes -> [N, 3] offsets."""
    masks = [*[mask for _, mask in _SPREAD][-2::-1], (1 << MAXIMUM_DEPTH) - 1]
    shifts = [shift for shift, _ in _SPREAD][::-1]
    offsets = np.empty((len(codes), 3), np.int64)
    for axis in range(3):
        v = (codes >> (2 - axis)) & _SPREAD[-1][1]
        for shift, mask in zip(shifts, masks, strict=True):
            v = (v | (v >> shift)) & mask
        offsets[:, axis] = v
    return offsets


def sorted_morton(
    coordinates: NDArray[np.int32],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """[N, 3], N >= 1 -> origin [3], Morton codes in ascending order [N], the permutation that sorts [N].

    Raises NotEncodable for duplicates and for a cloud of more than 21 bits on an axis.
    """
    origin = octree_origin(coordinates)
    offsets = coordinates.astype(np.int64) - origin
    depth = octree_depth(offsets)
    if depth > MAXIMUM_DEPTH:
        axis = int(offsets.max(axis=0).argmax())
        raise NotEncodable(
            f"anchor positions: the scene spans {offsets[:, axis].max() + 1} voxels along {'xyz'[axis]}, "
            f"at most {1 << MAXIMUM_DEPTH} can be coded; use larger voxels or remove distant anchors"
        )
    codes = morton_codes(offsets)
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    same = np.flatnonzero(codes[1:] == codes[:-1])
    if len(same):
        voxel = tuple(map(int, coordinates[order[same[0]]]))
        raise NotEncodable(
            f"anchor positions: {len(same)} duplicates, the first at voxel {voxel}; "
            "expected at most one anchor in a voxel; merge them first"
        )
    return origin, codes, order


def morton_levels(codes: NDArray[np.int64], depth: int) -> NDArray[np.uint8]:
    """[N] ascending Morton codes -> [N] coarsest level on which each differs from the one before; 0 first."""
    levels = np.zeros(len(codes), np.uint8)  # bytes are sorted in a third of the time of longer integers
    # A difference in octal digit d, counted from the voxels, is one on level depth - d.
    digit = np.searchsorted(
        8 ** np.arange(1, MAXIMUM_DEPTH, dtype=np.int64), codes[1:] ^ codes[:-1], side="right"
    )
    levels[1:] = depth - digit
    return levels


def canonical_order(coordinates: NDArray[np.int32]) -> NDArray[np.int64]:
    """[N, 3] voxel coordinates, in any order -> [N] permutation: `coordinates[permutation]` is canonical.

    Raises NotEncodable for duplicates and for a cloud of more than 21 bits on an axis.
    """
    if len(coordinates) == 0:
        return np.zeros(0, np.int64)
    origin, codes, order = sorted_morton(coordinates)
    levels = morton_levels(codes, octree_depth(coordinates.astype(np.int64) - origin))
    return order[np.argsort(levels, kind="stable")]


def level_counts(coordinates: NDArray[np.int32]) -> NDArray[np.int64]:
    """[depth + 1] number of anchors in the prefix of each level: one for each occupied node of that level."""
    if len(coordinates) == 0:
        return np.zeros(1, np.int64)
    origin, codes, _ = sorted_morton(coordinates)
    depth = octree_depth(coordinates.astype(np.int64) - origin)
    return np.cumsum(np.bincount(morton_levels(codes, depth), minlength=depth + 1))


def walked_nodes(coordinates: NDArray[np.int32]) -> int:
    """Nodes of the octree that hold two anchors or more, on all levels above the voxels: a coder of positions walks
    along these.
    """
    if len(coordinates) == 0:
        return 0
    origin, codes, _ = sorted_morton(coordinates)
    levels = morton_levels(codes, octree_depth(coordinates.astype(np.int64) - origin)).astype(np.int64)
    # On level l such a node begins before each anchor that is finer than l, and whose predecessor is not.
    return int(np.maximum(np.diff(levels), 0).sum())


def represented(coordinates: NDArray[np.int32], level: int) -> NDArray[np.int64]:
    """[n]: of the anchors in the prefix of an octree level, how many anchors their nodes of that level hold.

    coordinates: [N, 3] of all anchors, in canonical order.
    """
    offsets = coordinates.astype(np.int64) - octree_origin(coordinates)
    nodes = morton_codes(offsets) >> 3 * (octree_depth(offsets) - level)
    _, first, counts = np.unique(nodes, return_index=True, return_counts=True)
    return counts[np.argsort(first)]
