"""Which splats touch which tiles, in depth order (CPU).

    box meets image? ──► visible ─┬─ ellipse against columns ──► slots (a splat's tiles, rows) ─┐
                                  └─ radix sort ──► depth order ────────────────────────────────┴──► entries

One depth sort; a stable counting sort by tile then leaves every tile's entries in depth order. An image
column of TILE_WIDTH pixels is cut by a splat's ellipse in an interval of rows that is known in closed form,
so a tile's entry holds exactly the rows in which alpha may reach the cutoff. All that is computed per splat
is computed, and stays, in the order of the input, whose neighbours are mostly neighbours in the image. Work
is cut into CHUNKS pieces whatever the number of threads.
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
MOST_SLOTS = 1 << 28  # of all splats together; beyond it memory, not time, would run out

# No "nnan", "ninf": comparisons with NaN decide what is visible.
FASTMATH = {"contract", "nsz", "arcp"}
f32 = np.float32
ZERO, HALF, ONE = f32(0), f32(0.5), f32(1)
INF = f32(np.inf)
SLACK = f32(0.01)  # pixels; the alpha test decides, the intervals only must not miss a pixel
TWO_LN_2 = f32(2 * math.log(2))
# exp(-q / 2) = 2^-(k^2 q): k is folded into the Cholesky factor, so that the kernels need exp2 only
EXP2_SCALE = f32(math.sqrt(0.5 / math.log(2)))


@dataclass(frozen=True, eq=False)
class TileLists:
    """E entries sorted by tile, front to back within a tile. Rows of invisible splats are not set."""

    visible: np.ndarray  # [M] bool
    packed: np.ndarray  # [M, PARAMETERS] float32: mean x, y; Cholesky l00, l10, l11; log2 opacity; R, G, B
    starts: np.ndarray  # [tiles + 1] int64: first entry of each tile, row by row
    entries: np.ndarray  # [E, 2] int32: splat; first and last row within the tile (first * 256 + last)
    first_slot: np.ndarray  # [M] int32
    slots_used: np.ndarray  # [M] int32
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
) -> TileLists:
    """The lists of all tiles. Raises MemoryError for splats that would need absurd amounts of it."""
    m = len(means2d)
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    log2_cutoff = f32(math.log2(settings.alpha_cutoff))
    visible, boxes = np.empty(m, np.bool_), np.empty((m, 4), np.int32)
    packed = np.empty((m, PARAMETERS), np.float32)
    found, room = np.empty(CHUNKS, np.int64), np.empty(CHUNKS, np.int64)
    find_visible(
        means2d, covariances, depths, opacities, colors, log2_cutoff, width, height,
        visible, boxes, packed, found, room,
    )  # fmt: skip
    if room.sum() > MOST_SLOTS:
        raise MemoryError(
            f"rasterization: {found.sum()} visible Gaussians cover {room.sum()} tiles of the image, at most "
            f"{MOST_SLOTS} fit; are the scales in world units?"
        )
    slots, rows = np.empty(room.sum(), np.int32), np.empty(room.sum(), np.int32)
    first_slot, slots_used = np.empty(m, np.int32), np.empty(m, np.int32)
    find_tiles(
        means2d, covariances, determinants, colors, log2_cutoff, tiles_x,
        visible, boxes, room, packed, slots, rows, first_slot, slots_used,
    )  # fmt: skip
    del boxes  # the peak of memory comes next

    keys, order = np.empty(found.sum(), np.uint32), np.empty(found.sum(), np.int32)
    gather_keys(visible, depths, found, keys, order)
    order = sort_by_key(keys, order)
    counts = np.empty((CHUNKS, tiles_x * tiles_y), np.int64)
    count_tiles(order, first_slot, slots_used, slots, counts)
    starts = np.empty(tiles_x * tiles_y + 1, np.int64)
    entries = np.empty((start_tiles(counts, starts), 2), np.int32)
    fill_tiles(order, first_slot, slots_used, slots, rows, counts, entries)
    return TileLists(visible, packed, starts, entries, first_slot, slots_used, slots)


@njit(inline="always")
def chunk_bounds(chunk, count):
    return chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS


@njit(inline="always")
def pixel_interval(low, high, size):
    """First and last of `size` pixels whose centres lie in [low, high]."""
    first = max(np.ceil(low - HALF), ZERO)
    last = min(np.floor(high - HALF), f32(size - 1))
    return first, last


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy", cache=True)
def find_visible(
    means,
    covariances,
    depths,
    opacities,
    colors,
    log2_cutoff,
    width,
    height,
    visible,
    boxes,
    packed,
    found,
    room,
):
    """Fills `visible` [M] and, of the visible, `boxes` [M, 4] and log2 opacity; counts for each chunk."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, means.shape[0])
        n, tiles = np.int64(0), np.int64(0)
        for i in range(begin, end):
            visible[i] = False
            finite = (depths[i] < INF) & (abs(colors[i, 0] + colors[i, 1] + colors[i, 2]) < INF)
            if not (finite & (opacities[i] > ZERO) & (opacities[i] < INF)):
                continue
            log2_opacity = np.log2(opacities[i])
            reach = TWO_LN_2 * (log2_opacity - log2_cutoff)  # squared, in standard deviations
            if not reach > ZERO:
                continue
            half_x, half_y = np.sqrt(reach * covariances[i, 0]), np.sqrt(reach * covariances[i, 2])
            x0, x1 = pixel_interval(means[i, 0] - half_x, means[i, 0] + half_x, width)
            y0, y1 = pixel_interval(means[i, 1] - half_y, means[i, 1] + half_y, height)
            if x0 <= x1 and y0 <= y1:
                boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = int(x0), int(x1), int(y0), int(y1)
                columns = int(x1) // TILE_WIDTH - int(x0) // TILE_WIDTH + 1
                tiles += columns * (int(y1) // TILE_HEIGHT - int(y0) // TILE_HEIGHT + 1)
                packed[i, 5] = log2_opacity
                visible[i] = True
                n += 1
        found[chunk], room[chunk] = n, tiles


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy", cache=True)
def find_tiles(
    means, covariances, determinants, colors, log2_cutoff, tiles_x, visible, boxes, room,
    packed, slots, rows, first_slot, slots_used,
):  # fmt: skip
    """Packs the visible splats, and lists the tiles (`slots`) and rows that each one touches."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, means.shape[0])
        slot = np.int64(0)
        for c in range(chunk):
            slot += room[c]
        for i in range(begin, end):
            if not visible[i]:
                continue
            x, y = means[i, 0], means[i, 1]
            a, b, c, det = covariances[i, 0], covariances[i, 1], covariances[i, 2], determinants[i]
            l00 = EXP2_SCALE * np.sqrt(c / det)
            packed[i, 0] = x
            packed[i, 1] = y
            packed[i, 2] = l00
            packed[i, 3] = -l00 * b / c
            packed[i, 4] = EXP2_SCALE / np.sqrt(c)
            packed[i, 6] = colors[i, 0]
            packed[i, 7] = colors[i, 1]
            packed[i, 8] = colors[i, 2]

            # Ellipse d^T cov^-1 d = reach: at dx, dy lies within b/a dx +- sqrt((reach - dx^2/a) det/a).
            reach = TWO_LN_2 * (packed[i, 5] - log2_cutoff)
            half_x = np.sqrt(reach * a)
            top_dx = b * np.sqrt(reach / c)  # where the ellipse is highest; lowest at -top_dx
            inv_a = ONE / a
            slope, spread, reach_a = b * inv_a, det * inv_a * inv_a, reach * a
            x0, x1, y0, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
            first = slot
            for column in range(x0 // TILE_WIDTH, x1 // TILE_WIDTH + 1):
                left = max(f32(column * TILE_WIDTH) + HALF - x, -half_x)
                right = min(f32(column * TILE_WIDTH + TILE_WIDTH) - HALF - x, half_x)
                high_dx = min(max(top_dx, left), right)
                low_dx = min(max(-top_dx, left), right)
                high = slope * high_dx + np.sqrt(max(reach_a - high_dx * high_dx, ZERO) * spread)
                low = slope * low_dx - np.sqrt(max(reach_a - low_dx * low_dx, ZERO) * spread)
                row0 = max(int(np.ceil(y + low - SLACK - HALF)), y0)
                row1 = min(int(np.floor(y + high + SLACK - HALF)), y1)
                if row0 > row1:
                    continue
                for row in range(row0 // TILE_HEIGHT, row1 // TILE_HEIGHT + 1):
                    top = row * TILE_HEIGHT
                    slots[slot] = row * tiles_x + column
                    rows[slot] = max(row0 - top, 0) * 256 + min(row1 - top, TILE_HEIGHT - 1)
                    slot += 1
            first_slot[i] = first
            slots_used[i] = slot - first


@njit(parallel=True, cache=True)
def gather_keys(visible, depths, found, keys, order):
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


def sort_by_key(keys: np.ndarray, order: np.ndarray) -> np.ndarray:
    """`order` sorted by `keys` [S] uint32: a stable radix sort over the bits in which keys differ."""
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
def count_tiles(order, first_slot, slots_used, slots, counts):
    """Entries of each tile, by chunk of the depth order."""
    for chunk in prange(CHUNKS):
        counts[chunk, :] = 0
        begin, end = chunk_bounds(chunk, order.shape[0])
        for rank in range(begin, end):
            i = order[rank]
            for slot in range(first_slot[i], first_slot[i] + slots_used[i]):
                counts[chunk, slots[slot]] += 1


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
def fill_tiles(order, first_slot, slots_used, slots, rows, counts, entries):
    """Writes the tiles' entries in depth order; the slots then say where a splat's entries are."""
    for chunk in prange(CHUNKS):
        begin, end = chunk_bounds(chunk, order.shape[0])
        for rank in range(begin, end):
            i = order[rank]
            for slot in range(first_slot[i], first_slot[i] + slots_used[i]):
                tile = slots[slot]
                to = counts[chunk, tile]
                counts[chunk, tile] = to + 1
                entries[to, 0] = i
                entries[to, 1] = rows[slot]
                slots[slot] = to
