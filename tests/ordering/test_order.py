"""The canonical order: prefixes are coarse scenes, whatever order the anchors came in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compgs.errors import NotEncodable
from compgs.ordering.order import (
    canonical_order,
    inv_morton_codes,
    level_counts,
    morton_codes,
    octree_depth,
    octree_origin,
)


@st.composite
def clouds(draw: st.DrawFn) -> NDArray[np.int32]:
    """[N, 3] distinct voxels, 1 to 80 of them, in no order, spread over 1 to 20 bits."""
    bits = draw(st.integers(1, 20))
    shift = draw(st.integers(-(1 << 30), 1 << 30))
    points = draw(
        st.lists(st.tuples(*[st.integers(0, (1 << bits) - 1)] * 3), min_size=1, max_size=80, unique=True)
    )
    return (np.array(points, np.int64) + np.array([shift, 0, -shift])).astype(np.int32)


def slow_morton(point: NDArray[np.int64]) -> int:
    x, y, z = (int(v) for v in point)
    return sum(
        (x >> b & 1) << (3 * b + 2) | (y >> b & 1) << (3 * b + 1) | (z >> b & 1) << (3 * b) for b in range(21)
    )


@given(st.lists(st.tuples(*[st.integers(0, (1 << 21) - 1)] * 3), max_size=50))
def test_morton_codes_interleave_bits(points: list[tuple[int, int, int]]) -> None:
    offsets = np.array(points, np.int64).reshape(-1, 3)
    codes = morton_codes(offsets)
    assert codes.tolist() == [slow_morton(p) for p in offsets]
    assert (inv_morton_codes(codes) == offsets).all()


@given(clouds())
@settings(deadline=None)
def test_each_prefix_has_one_anchor_for_each_node_of_its_level(cloud: NDArray[np.int32]) -> None:
    ordered = cloud[canonical_order(cloud)].astype(np.int64)
    counts = level_counts(cloud)
    offsets = ordered - octree_origin(cloud)
    depth = octree_depth(offsets)
    assert len(counts) == depth + 1
    for level, count in enumerate(counts):
        nodes = offsets >> (depth - level)
        occupied = {tuple(n) for n in nodes.tolist()}
        assert len({tuple(n) for n in nodes[:count].tolist()}) == count == len(occupied)
    assert counts[0] == 1
    assert counts[-1] == len(cloud)


@given(clouds(), st.integers(0, 1000))
@settings(deadline=None)
def test_the_order_depends_on_positions_alone(cloud: NDArray[np.int32], seed: int) -> None:
    shuffled = cloud[np.random.default_rng(seed).permutation(len(cloud))]
    assert (shuffled[canonical_order(shuffled)] == cloud[canonical_order(cloud)]).all()
    assert sorted(canonical_order(cloud).tolist()) == list(range(len(cloud)))


@given(clouds())
@settings(deadline=None)
def test_sorting_twice_changes_nothing(cloud: NDArray[np.int32]) -> None:
    ordered = cloud[canonical_order(cloud)]
    assert (canonical_order(ordered) == np.arange(len(cloud))).all()


def test_within_a_level_anchors_follow_their_morton_codes() -> None:
    cloud = np.unique(np.random.default_rng(0).integers(0, 64, (300, 3)), axis=0).astype(np.int32)
    codes = morton_codes(cloud[canonical_order(cloud)] - octree_origin(cloud))
    ends = level_counts(cloud)
    for start, stop in zip([0, *ends[:-1]], ends, strict=True):
        assert (np.diff(codes[start:stop]) > 0).all()


def test_the_origin_keeps_coarse_grids_aligned() -> None:
    cloud = np.array([[-17, 16, 31], [5, 40, 33]], np.int32)
    assert octree_origin(cloud).tolist() == [-32, 16, 16]


def test_no_anchors_have_an_order_too() -> None:
    none = np.zeros((0, 3), np.int32)
    assert len(canonical_order(none)) == 0
    assert level_counts(none).tolist() == [0]


def test_duplicates_are_refused_by_name() -> None:
    cloud = np.array([[1, 2, 3], [-4, 5, 6], [1, 2, 3]], np.int32)
    with pytest.raises(NotEncodable, match=r"1 duplicates, the first at voxel \(1, 2, 3\)"):
        canonical_order(cloud)


def test_a_cloud_of_more_than_21_bits_is_refused() -> None:
    widest = np.array([[0, 0, 0], [0, (1 << 21) - 1, 0]], np.int32)
    assert canonical_order(widest).tolist() == [0, 1]
    with pytest.raises(NotEncodable, match="2097153 voxels along y"):
        canonical_order(widest + np.array([[0, 0, 0], [0, 1, 0]], np.int32))
    with pytest.raises(NotEncodable, match="along x"):
        canonical_order(np.array([[-(1 << 31), 0, 0], [(1 << 31) - 1, 0, 0]], np.int32))
