"""Sorting and tile lists against brute force."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from compgs.render.binning import FEW, TILE_HEIGHT, TILE_WIDTH, TileLists, bin_splats, sort_tiles
from compgs.render.settings import RasterSettings

WIDTH, HEIGHT = 45, 70


def sorted_tiles(keys: np.ndarray, starts: np.ndarray) -> np.ndarray:
    order = np.empty(len(keys), np.int32)
    sort_tiles(starts, keys, order)
    return order


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(np.uint32, st.integers(0, 300), elements=st.integers(0, 2**32 - 1)),
    st.lists(st.integers(0, 300), max_size=20),
)
def test_each_tile_is_sorted_stably_and_by_itself(keys, cuts):
    starts = np.array([0, *sorted(min(c, len(keys)) for c in cuts), len(keys)])
    expected = [
        begin + np.argsort(keys[begin:end], kind="stable") for begin, end in itertools.pairwise(starts)
    ]
    assert np.array_equal(sorted_tiles(keys, starts), np.concatenate(expected))


@pytest.mark.parametrize("count", [1, FEW, FEW + 1, 5000])
@pytest.mark.parametrize("most", [8, 300, 2**32])
def test_sorting_keeps_the_order_of_equal_keys(count, most):
    keys = np.random.default_rng(0).integers(7, most, count).astype(np.uint32)
    keys[count // 2 :] = keys[: count - count // 2]
    starts = np.array([0, count])
    assert np.array_equal(sorted_tiles(keys, starts), np.argsort(keys, kind="stable"))


def make_splats(seed: int, count: int = 60) -> dict[str, np.ndarray]:
    r = np.random.default_rng(seed)
    factor = r.normal(size=(count, 2, 2)) * np.exp(r.normal(0.5, 1, (count, 1, 1)))
    cov = factor @ factor.transpose(0, 2, 1) + 0.3 * np.eye(2)
    splats = dict(
        means2d=r.uniform(-10, 80, (count, 2)),
        covariances=np.stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]], -1),
        determinants=np.linalg.det(cov),
        depths=r.uniform(1, 5, count),
        opacities=r.uniform(0, 1, count),
        colors=r.uniform(0, 1, (count, 3)),
    )
    return {k: v.astype(np.float32) for k, v in splats.items()}


def touched(splats: dict[str, np.ndarray], i: int) -> np.ndarray:
    """[HEIGHT, WIDTH] bool: pixels where splat i's alpha reaches the cutoff, by definition."""
    a, b, c = (float(v) for v in splats["covariances"][i])
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    dx, dy = splats["means2d"][i, 0] - x, splats["means2d"][i, 1] - y
    q = (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b)
    return splats["opacities"][i] * np.exp(-q / 2) >= 1 / 255


def pixels_of(lists: TileLists, tile: int, entry: int) -> tuple[slice, slice]:
    """Rows and columns of the image that an entry covers."""
    tiles_x = -(-WIDTH // TILE_WIDTH)
    top, left = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
    first, last = lists.entries[entry, 1] >> 8, lists.entries[entry, 1] & 255
    return slice(top + first, top + last + 1), slice(left, left + TILE_WIDTH)


@pytest.mark.parametrize("seed", range(4))
def test_entries_cover_every_touched_pixel_once_and_few_others(seed):
    splats = make_splats(seed)
    lists = bin_splats(**splats, width=WIDTH, height=HEIGHT, settings=RasterSettings())
    covered = np.zeros((60, HEIGHT, WIDTH), np.int32)
    for tile in range(len(lists.starts) - 1):
        for entry in range(lists.starts[tile], lists.starts[tile + 1]):
            covered[lists.entries[entry, 0]][pixels_of(lists, tile, entry)] += 1
    touches = np.stack([touched(splats, i) for i in range(60)])
    assert covered.max() == 1
    assert np.all(covered[touches] == 1)
    assert touches.sum() > 0.5 * covered.sum()


def test_entries_of_a_tile_go_front_to_back_and_slots_find_them():
    splats = make_splats(1, 500)
    lists = bin_splats(**splats, width=WIDTH, height=HEIGHT, settings=RasterSettings())
    for tile in range(len(lists.starts) - 1):
        entries = lists.order[lists.starts[tile] : lists.starts[tile + 1]]
        assert np.array_equal(np.sort(entries), np.arange(lists.starts[tile], lists.starts[tile + 1]))
        depths = splats["depths"][lists.entries[entries, 0]]
        assert np.all(np.diff(depths) >= 0)
    for i in np.nonzero(lists.visible)[0]:
        slots = lists.slots[lists.first_slot[i] : lists.first_slot[i] + lists.slots_used[i]]
        assert np.all(lists.entries[slots, 0] == i)
    assert lists.slots_used[lists.visible].sum() == len(lists.entries)
