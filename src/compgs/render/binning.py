"""Which splats touch which tiles, in depth order (CPU).

    splats ──box meets image──► visible ──radix sort──► by depth ──ellipse against columns──► entries of tiles

One depth sort; a stable counting sort by tile then leaves every tile's entries in depth order. An image
column of TILE_WIDTH pixels is cut by a splat's ellipse in an interval of rows that is known in closed form,
so a tile's entry holds exactly the rows in which alpha may reach the cutoff. Work is cut into CHUNKS pieces
whatever the number of threads.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from compgs.render.settings import RasterSettings

TILE_WIDTH = 8  # pixels
TILE_HEIGHT = 32  # pixels
CHUNKS = 16
PARAMETERS = 9  # of a packed splat
RADIX_BITS = 11
MOST_ENTRIES = 1 << 28  # of all tiles together; beyond it memory, not time, would run out

# No "nnan", "ninf": comparisons with NaN decide what is visible.
FASTMATH = {"contract", "nsz", "arcp"}
f32 = np.float32
HALF, TWO = f32(0.5), f32(2)
SLACK = f32(0.01)  # pixels; the alpha test decides, the intervals only must not miss a pixel
# exp(-q / 2) = 2^-(k^2 q): folded into the Cholesky factor, so that the kernels need exp2 only
EXP2_SCALE = f32(math.sqrt(0.5 / math.log(2.0)))


@dataclass(frozen=True, eq=False)
class TileLists:
    """S visible splats in depth order, and E entries sorted by tile, front to back within a tile."""

    order: np.ndarray  # [S] int32: which Gaussian
    packed: (
        np.ndarray
    )  # [S, PARAMETERS] float32: mean x, y; Cholesky l00, l10, l11; log2 opacity; red, green, blue
    starts: np.ndarray  # [tiles + 1] int64: first entry of each tile, row by row
    entries: np.ndarray  # [E, 2] int32: splat, first and last row within the tile (first * 256 + last)
    first_slot: np.ndarray  # [S] int64: first of a splat's slots
    slots_used: np.ndarray  # [S] int32: number of a splat's slots
    slots: np.ndarray  # [..] int32: the splats' entries, splat by splat (with gaps)


def bin_splats(
    means2d: np.ndarray,  # [M, 2] pixels
    covariances: np.ndarray,  # [M, 3] pixels^2
    determinants: np.ndarray,  # [M] pixels^4
    depths: np.ndarray,  # [M] world units, inf where not drawn
    opacities: np.ndarray,  # [M]
    colors: np.ndarray,  # [M, 3]
    width: int,
    height: int,
    settings: RasterSettings,
) -> tuple[TileLists, np.ndarray]:
    """The tiles' lists, and which Gaussians are visible [M] bool."""
    m = len(means2d)
    cutoff = f32(settings.alpha_cutoff)
    boxes = np.empty((m, 4), np.int32)  # pixels: first and last column, first and last row
    visible = np.empty(m, np.bool_)
    splats_of_chunk = np.empty(CHUNKS, np.int64)
    find_visible(
        means2d,
        covariances,
        depths,
        opacities,
        colors,
        cutoff,
        width,
        height,
        boxes,
        visible,
        splats_of_chunk,
    )
    s = int(splats_of_chunk.sum())
    keys, order = np.empty(s, np.uint32), np.empty(s, np.int32)
    gather_visible(visible, depths, splats_of_chunk, keys, order)
    order = sort_by_depth(keys, order)

    slots_of_chunk = np.empty(CHUNKS, np.int64)
    sum_boxes(boxes, order, slots_of_chunk)
    capacity = int(slots_of_chunk.sum())
    if capacity > MOST_ENTRIES:
        raise MemoryError(
            f"rasterization: {s} visible Gaussians cover {capacity} tiles, at most {MOST_ENTRIES} fit; "
            "are the scales in world units?"
        )
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    packed = np.empty((s, PARAMETERS), np.float32)
    slots, rows = np.empty(capacity, np.int32), np.empty(capacity, np.int32)
    first_slot, slots_used = np.empty(s, np.int64), np.empty(s, np.int32)
    counts = np.zeros((CHUNKS, tiles_x * tiles_y), np.int64)
    splats = (means2d, covariances, determinants, opacities, colors, order)
    find_tiles(
        *splats, boxes, cutoff, tiles_x, slots_of_chunk, packed, slots, rows, first_slot, slots_used, counts
    )
    starts = np.empty(tiles_x * tiles_y + 1, np.int64)
    entries = np.empty((start_tiles(counts, starts), 2), np.int32)
    fill_tiles(slots, rows, first_slot, slots_used, counts, entries)
    return TileLists(order, packed, starts, entries, first_slot, slots_used, slots), visible


@njit(inline="always")
def chunk_bounds(chunk, count):
    return chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS


@njit(inline="always")
def pixel_interval(low, high, size):
    """First and last of `size` pixels whose centres lie in [low, high]."""
    first = max(math.ceil(low - HALF), f32(0))
    last = min(math.floor(high - HALF), f32(size - 1))
    return first, last


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy", cache=True)
def find_visible(means, covariances, depths, opacities, colors, cutoff, width, height, boxes, visible, found):
    """Fills `visible` [M], `boxes` [M, 4] of the visible, and the number of visible splats of each chunk."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, means.shape[0])
        n = 0
        for i in range(begin, end):
            visible[i] = False
            if not (opacities[i] > cutoff and opacities[i] < f32(np.inf) and depths[i] < f32(np.inf)):
                continue
            if not abs(colors[i, 0] + colors[i, 1] + colors[i, 2]) < f32(np.inf):
                continue
            reach = TWO * math.log(opacities[i] / cutoff)
            half_x, half_y = math.sqrt(reach * covariances[i, 0]), math.sqrt(reach * covariances[i, 2])
            x0, x1 = pixel_interval(means[i, 0] - half_x, means[i, 0] + half_x, width)
            y0, y1 = pixel_interval(means[i, 1] - half_y, means[i, 1] + half_y, height)
            if x0 <= x1 and y0 <= y1:
                boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = int(x0), int(x1), int(y0), int(y1)
                visible[i] = True
                n += 1
        found[chunk] = n


@njit(parallel=True, cache=True)
def gather_visible(visible, depths, found, keys, order):
    """Depth keys and indices of the visible splats, in the order of the input."""
    bits = depths.view(np.uint32)  # depths are positive: their bits sort as they do
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, visible.shape[0])
        n = np.int64(0)
        for c in range(chunk):
            n += found[c]
        for i in range(begin, end):
            if visible[i]:
                keys[n] = bits[i]
                order[n] = i
                n += 1


def sort_by_depth(keys: np.ndarray, order: np.ndarray) -> np.ndarray:
    """`order` sorted by key: stable radix sort over the bits in which keys differ, lowest digit first."""
    if len(keys) == 0:
        return order
    lowest = keys.min()
    span = int(keys.max() - lowest).bit_length()
    counts = np.empty((CHUNKS, 1 << RADIX_BITS), np.int32)
    for shift in range(0, span, RADIX_BITS):
        sorted_keys, sorted_order = np.empty_like(keys), np.empty_like(order)
        radix_pass(keys, order, lowest, np.uint32(shift), counts, sorted_keys, sorted_order)
        keys, order = sorted_keys, sorted_order
    return order


@njit(parallel=True, cache=True)
def radix_pass(keys, order, lowest, shift, counts, sorted_keys, sorted_order):
    n = keys.shape[0]
    digits = np.uint32((1 << RADIX_BITS) - 1)
    for chunk in prange(CHUNKS):
        counts[chunk, :] = 0
        begin, end = chunk_bounds(chunk, n)
        for i in range(begin, end):
            counts[chunk, ((keys[i] - lowest) >> shift) & digits] += 1
    position = np.int32(0)
    for digit in range(1 << RADIX_BITS):
        for chunk in range(CHUNKS):
            here = counts[chunk, digit]
            counts[chunk, digit] = position
            position += here
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, n)
        for i in range(begin, end):
            digit = ((keys[i] - lowest) >> shift) & digits
            to = counts[chunk, digit]
            counts[chunk, digit] = to + 1
            sorted_keys[to] = keys[i]
            sorted_order[to] = order[i]


@njit(parallel=True, cache=True)
def sum_boxes(boxes, order, sums):
    """Tiles of the boxes of each chunk of the sorted splats: room for its slots."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, order.shape[0])
        n = np.int64(0)
        for i in range(begin, end):
            g = order[i]
            columns = boxes[g, 1] // TILE_WIDTH - boxes[g, 0] // TILE_WIDTH + 1
            n += np.int64(columns) * (boxes[g, 3] // TILE_HEIGHT - boxes[g, 2] // TILE_HEIGHT + 1)
        sums[chunk] = n


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy", cache=True)
def find_tiles(
    means, covariances, determinants, opacities, colors, order, boxes, cutoff, tiles_x, room,
    packed, slots, rows, first_slot, slots_used, counts,
):  # fmt: skip
    """Packs the splats in depth order, and lists the tiles (`slots`) and rows that each one touches."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, order.shape[0])
        slot = np.int64(0)
        for c in range(chunk):
            slot += room[c]
        for i in range(begin, end):
            g = order[i]
            x, y, opacity = means[g, 0], means[g, 1], opacities[g]
            a, b, c, det = covariances[g, 0], covariances[g, 1], covariances[g, 2], determinants[g]
            l00 = EXP2_SCALE * math.sqrt(c / det)
            packed[i, 0] = x
            packed[i, 1] = y
            packed[i, 2] = l00
            packed[i, 3] = -l00 * b / c
            packed[i, 4] = EXP2_SCALE / math.sqrt(c)
            packed[i, 5] = math.log2(opacity)
            packed[i, 6] = colors[g, 0]
            packed[i, 7] = colors[g, 1]
            packed[i, 8] = colors[g, 2]

            # The ellipse d^T cov^-1 d = reach: at a given dx, dy lies within b/a dx +- sqrt((reach - dx^2/a)
            # det/a).
            reach = TWO * math.log(opacity / cutoff)
            half_x = math.sqrt(reach * a)
            top_dx = b * math.sqrt(reach / c)  # where the ellipse is highest; lowest at -top_dx
            slope, spread = b / a, det / a
            first_slot[i] = slot
            for column in range(boxes[g, 0] // TILE_WIDTH, boxes[g, 1] // TILE_WIDTH + 1):
                left = max(f32(column * TILE_WIDTH) + HALF - x, -half_x)
                right = min(f32(column * TILE_WIDTH + TILE_WIDTH) - HALF - x, half_x)
                high_dx = min(max(top_dx, left), right)
                low_dx = min(max(-top_dx, left), right)
                high = slope * high_dx + math.sqrt(max(reach - high_dx * high_dx / a, f32(0)) * spread)
                low = slope * low_dx - math.sqrt(max(reach - low_dx * low_dx / a, f32(0)) * spread)
                row0 = max(math.ceil(y + low - SLACK - HALF), boxes[g, 2])
                row1 = min(math.floor(y + high + SLACK - HALF), boxes[g, 3])
                if row0 > row1:
                    continue
                for row in range(row0 // TILE_HEIGHT, row1 // TILE_HEIGHT + 1):
                    tile = row * tiles_x + column
                    slots[slot] = tile
                    rows[slot] = max(row0 - row * TILE_HEIGHT, 0) * 256 + min(
                        row1 - row * TILE_HEIGHT, TILE_HEIGHT - 1
                    )
                    counts[chunk, tile] += 1
                    slot += 1
            slots_used[i] = slot - first_slot[i]


@njit(cache=True)
def start_tiles(counts, starts):
    """Exclusive sums over tiles, then chunks: `counts` becomes where each chunk writes. Returns the total."""
    chunks, tiles = counts.shape
    position = np.int64(0)
    for tile in range(tiles):
        starts[tile] = position
        for chunk in range(chunks):
            here = counts[chunk, tile]
            counts[chunk, tile] = position
            position += here
    starts[tiles] = position
    return position


@njit(parallel=True, cache=True)
def fill_tiles(slots, rows, first_slot, slots_used, counts, entries):
    """Writes the tiles' entries; a splat's slots then say where they are."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, first_slot.shape[0])
        for i in range(begin, end):
            for slot in range(first_slot[i], first_slot[i] + slots_used[i]):
                tile = slots[slot]
                to = counts[chunk, tile]
                counts[chunk, tile] = to + 1
                entries[to, 0] = i
                entries[to, 1] = rows[slot]
                slots[slot] = to
