"""Neighbours against their definition: all known anchors, one after the other."""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgs.ordering.neighbours import AROUND, NEAREST_WEIGHT, find_neighbours
from compgs.ordering.order import canonical_order, level_counts, octree_depth, octree_origin


def octree(seed: int, anchors: int, spread: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Offsets in canonical order, anchors up to each level, depth."""
    rng = np.random.default_rng(seed)
    coordinates = np.unique(rng.integers(-spread, spread, (anchors, 3)), axis=0).astype(np.int32)
    coordinates = coordinates[canonical_order(coordinates)]
    offsets = (coordinates.astype(np.int64) - octree_origin(coordinates)).astype(np.int32)
    return offsets, level_counts(coordinates), octree_depth(offsets.astype(np.int64))


@given(st.integers(0, 1 << 20), st.integers(2, 200), st.sampled_from([3, 20, 500, 100_000]), st.data())
@settings(max_examples=60, deadline=None)
def test_neighbours_are_the_known_anchors_of_nodes_that_touch_ones_own(
    seed: int, anchors: int, spread: int, data: st.DataObject
) -> None:
    offsets, counts, depth = octree(seed, anchors, spread)
    level = data.draw(st.integers(0, depth), "level")
    known, shift = int(counts[level]), depth - level
    found = find_neighbours(offsets, known, shift)
    first, neighbours, weights = found.weights(offsets)
    assert found.node.shape == (len(offsets) - known,) and found.around.shape == (known, AROUND)
    for i, own in enumerate(offsets[known:].tolist()):
        expected = {
            j: 1 + NEAREST_WEIGHT // sum(abs(a - b) for a, b in zip(own, other, strict=True))
            for j, other in enumerate(offsets[:known].tolist())
            if all(abs((a >> shift) - (b >> shift)) <= 1 for a, b in zip(own, other, strict=True))
        }
        part = slice(first[i], first[i + 1])
        assert dict(zip(neighbours[part].tolist(), weights[part].tolist(), strict=True)) == expected
        assert 1 <= len(expected) <= AROUND
        node = offsets[found.node[i]] >> shift
        assert (node == offsets[known + i] >> shift).all()


def test_at_the_ends_of_the_largest_octree_neighbours_are_found() -> None:
    """21 bits an axis, all eight corners of it, and a node whose neighbours would lie outside."""
    top = (1 << 21) - 1
    offsets = np.array([*product((0, top), repeat=3), (top - 1, top, top)], np.int32)
    offsets = offsets[canonical_order(offsets)]
    for shift in (20, 21):
        known = 8 if shift == 20 else 1
        found = find_neighbours(offsets, known, shift)
        first, neighbours, weights = found.weights(offsets)
        assert first[-1] == len(neighbours) == known * (9 - known)
        assert weights.min() >= 1


@pytest.mark.parametrize("threads", [1, 2])
def test_neighbours_do_not_depend_on_the_number_of_threads(
    threads: int, with_threads: Callable[[int], None]
) -> None:
    offsets, counts, depth = octree(1, 5000, 60)
    level = depth - 2
    with_threads(threads)
    found = find_neighbours(offsets, int(counts[level]), 2)
    mean = (found.around[found.node] >= 0).sum(1).mean()
    assert 2 < mean < AROUND
    total = int(found.around.astype(np.int64).sum()), int(found.node.astype(np.int64).sum())
    alone = find_neighbours(offsets, int(counts[level]), 2)
    assert total == (int(alone.around.astype(np.int64).sum()), int(alone.node.astype(np.int64).sum()))
