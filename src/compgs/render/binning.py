"""Which splats touch which tiles, in depth order (CPU).

    box meets image? ──► visible ──► ellipse against columns ──► slots (a splat's tiles, rows)
                                  ──► counting sort by tile ──► entries ──► radix sort of each tile ──► order

An image column of TILE_WIDTH pixels is cut by a splat's ellipse in an interval of rows that is known in closed
form, so a tile's entry holds exactly the rows in which alpha may reach the cutoff. All that is computed per
splat is computed, and stays, in the order of the input, whose neighbours are mostly neighbours in the image.
Tiles are sorted by depth one by one, within a core's cache: one sort of all splats before they are handed out
to tiles would read them in an order that no cache can follow (twice the time). Both sorts are stable: splats of
equal depth stay in the order of the input. Work is cut into CHUNKS pieces whatever the number of threads.
"""

import math
from dataclasses import dataclass

import numpy as np

from compgs.numerics.compiled import chunk_of, njit
from compgs.render.settings import RasterSettings

TILE_WIDTH = 8  # pixels
TILE_HEIGHT = 32  # pixels
CHUNKS = 16
PARAMETERS = 9  # of a packed splat
TILE_X_BITS, TILE_Y_BITS = 3, 5  # shifts, not divisions: those of signed numbers are slow
RADIX_BITS = 8
RADIX = 1 << RADIX_BITS
DIGITS = 4  # of a depth key
FEW = 32  # entries that are sorted by insertion: counting 256 digits costs more
STRIDE = 16  # tiles; threads get runs of turns, and a run of neighbouring tiles may hold most of the splats
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
    """E entries sorted by tile, and their order front to back. Rows of invisible splats are not set."""

    visible: np.ndarray  # [M] bool
    packed: np.ndarray  # [M, PARAMETERS] float32: mean x, y; Cholesky l00, l10, l11; log2 opacity; R, G, B
    starts: np.ndarray  # [tiles + 1] int64: first entry of each tile, row by row
    entries: np.ndarray  # [E, 2] int32: splat; first and last row within the tile (first * 256 + last)
    order: np.ndarray  # [E] int32: the entries of each tile, front to back
    first_slot: np.ndarray  # [M] int32
    slots_used: np.ndarray  # [M] int32
    slots: np.ndarray  # [..] int32: the splats' entries, splat by splat (with gaps)


@dataclass(frozen=True, eq=False)
class PackedSplats:
    """M splats as blending reads them, and the tiles that each one touches. Rows of invisible splats are not set."""

    visible: np.ndarray  # [M] bool
    packed: np.ndarray  # [M, PARAMETERS] float32
    first_slot: np.ndarray  # [M] int32
    slots_used: np.ndarray  # [M] int32
    slots: np.ndarray  # [..] int32: tiles, splat by splat (with gaps)
    rows: np.ndarray  # [..] uint16: first and last row within the tile (first * 256 + last)
    counts: np.ndarray  # [CHUNKS, tiles] int64: slots of each chunk of splats, by tile


def bin_splats(
    means2d: np.ndarray,
    covariances: np.ndarray,
    determinants: np.ndarray,
    depths: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    width: int,
    height: int,
    settings: RasterSettings,
) -> TileLists:
    """The lists of all tiles; arguments as those of `pack_splats`."""
    splats = pack_splats(
        means2d, covariances, determinants, depths, opacities, colors, width, height, settings
    )
    return list_tiles(splats, depths)


def pack_splats(
    means2d: np.ndarray,  # [M, 2] pixels
    covariances: np.ndarray,  # [M, 3] pixels^2
    determinants: np.ndarray,  # [M] pixels^4
    depths: np.ndarray,  # [M] world units, inf where not drawn
    opacities: np.ndarray,  # [M]
    colors: np.ndarray,  # [M, 3]
    width: int,
    height: int,
    settings: RasterSettings,
    packed: np.ndarray | None = None,  # [M, PARAMETERS] to be filled
) -> PackedSplats:
    """Raises MemoryError for splats that would need absurd amounts of it.

    All but determinants and depths may lie in `packed` already, opacities in the column of their logarithm: a splat's
    are read before they are written.
    """
    m = len(means2d)
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    log2_cutoff = f32(math.log2(settings.alpha_cutoff))
    pixel = np.uint16 if max(width, height) < 1 << 16 else np.int32  # memory: this is near its peak
    visible, boxes = np.empty(m, np.bool_), np.empty((m, 4), pixel)
    if packed is None:
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
    slots, rows = np.empty(room.sum(), np.int32), np.empty(room.sum(), np.uint16)
    first_slot, slots_used = np.empty(m, np.int32), np.empty(m, np.int32)
    counts = np.empty((CHUNKS, tiles_x * tiles_y), np.int64)
    find_tiles(
        means2d, covariances, determinants, colors, log2_cutoff, tiles_x,
        visible, boxes, room, packed, slots, rows, first_slot, slots_used, counts,
    )  # fmt: skip
    return PackedSplats(visible, packed, first_slot, slots_used, slots, rows, counts)


def list_tiles(splats: PackedSplats, depths: np.ndarray) -> TileLists:
    """The lists of all tiles. The slots and counts of `splats` are used up: they become those of the lists."""
    s = splats
    starts = np.empty(s.counts.shape[1] + 1, np.int64)
    total = start_tiles(s.counts, starts)
    entries, keys = np.empty((total, 2), np.int32), np.empty(total, np.uint32)
    fill_tiles(s.visible, depths, s.first_slot, s.slots_used, s.slots, s.rows, s.counts, entries, keys)
    order = keys.view(np.int32)
    sort_tiles(starts, keys, order)
    return TileLists(s.visible, s.packed, starts, entries, order, s.first_slot, s.slots_used, s.slots)


@njit(inline="always")
def chunk_bounds(chunk, count):
    return chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS


@njit(inline="always")
def turns(tiles):
    return (tiles + STRIDE - 1) // STRIDE * STRIDE


@njit(inline="always")
def tile_at(turn, tiles):
    """Every STRIDE-th tile, then the next such series: each thread's share is spread over the image."""
    series = (tiles + STRIDE - 1) // STRIDE
    return turn % series * STRIDE + turn // series


@njit(inline="always")
def signed(number):
    """An unsigned number that may be mixed with signed ones: numba would make floats of them."""
    return np.int64(number)


@njit(inline="always")
def pixel_interval(low, high, size):
    """First and last of `size` pixels whose centres lie in [low, high]."""
    first = max(np.ceil(low - HALF), ZERO)
    last = min(np.floor(high - HALF), f32(size - 1))
    return first, last


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
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
    part,
):
    """Fills `visible` [M] and, of the visible, `boxes` [M, 4] and log2 opacity; counts for each chunk."""
    for chunk in chunk_of(CHUNKS, part):
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
                columns = (int(x1) >> TILE_X_BITS) - (int(x0) >> TILE_X_BITS) + 1
                tiles += columns * ((int(y1) >> TILE_Y_BITS) - (int(y0) >> TILE_Y_BITS) + 1)
                packed[i, 5] = log2_opacity
                visible[i] = True
                n += 1
        found[chunk], room[chunk] = n, tiles


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
def find_tiles(
    means, covariances, determinants, colors, log2_cutoff, tiles_x, visible, boxes, room,
    packed, slots, rows, first_slot, slots_used, counts,
    part,
):  # fmt: skip
    """Packs the visible splats, lists the tiles (`slots`) and rows that each one touches, and counts by tile."""
    for chunk in chunk_of(CHUNKS, part):
        counts[chunk, :] = 0
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
            x0, x1, y0, y1 = (
                signed(boxes[i, 0]),
                signed(boxes[i, 1]),
                signed(boxes[i, 2]),
                signed(boxes[i, 3]),
            )
            first = slot
            for column in range(x0 >> TILE_X_BITS, (x1 >> TILE_X_BITS) + 1):
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
                for row in range(row0 >> TILE_Y_BITS, (row1 >> TILE_Y_BITS) + 1):
                    top = row * TILE_HEIGHT
                    slots[slot] = row * tiles_x + column
                    counts[chunk, row * tiles_x + column] += 1
                    rows[slot] = max(row0 - top, 0) * 256 + min(row1 - top, TILE_HEIGHT - 1)
                    slot += 1
            first_slot[i] = first
            slots_used[i] = slot - first


@njit
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


@njit(parallel=True)
def fill_tiles(visible, depths, first_slot, slots_used, slots, rows, counts, entries, keys, part):
    """Writes the tiles' entries and depth keys; the slots then say where a splat's entries are."""
    bits = depths.view(np.uint32)  # depths are positive: their bits sort as they do
    for chunk in chunk_of(CHUNKS, part):
        begin, end = chunk_bounds(chunk, visible.shape[0])
        for i in range(begin, end):
            if not visible[i]:
                continue
            for slot in range(first_slot[i], first_slot[i] + slots_used[i]):
                tile = slots[slot]
                to = counts[chunk, tile]
                counts[chunk, tile] = to + 1
                entries[to, 0] = i
                entries[to, 1] = rows[slot]
                keys[to] = bits[i]
                slots[slot] = to


@njit(parallel=True)
def sort_tiles(starts, keys, order, part):
    """`order` [E]: each tile's entries by `keys` [E], equal ones as they come. It may take the place of the keys."""
    tiles = starts.shape[0] - 1
    for turn in chunk_of(turns(tiles), part):
        tile = tile_at(turn, tiles)
        if tile < tiles:
            begin, end = starts[tile], starts[tile + 1]
            if end - begin <= FEW:
                sort_few(keys[begin:end], order[begin:end], begin)
            else:
                sort_many(keys[begin:end], order[begin:end], begin)


@njit
def sort_few(keys, order, begin):
    """Insertion sort."""
    sorted_keys = np.empty(FEW, np.uint32)
    for i in range(keys.shape[0]):
        key, at = keys[i], i
        while at > 0 and sorted_keys[at - 1] > key:
            sorted_keys[at], order[at] = sorted_keys[at - 1], order[at - 1]
            at -= 1
        sorted_keys[at], order[at] = key, begin + i


@njit
def sort_many(keys, order, begin):
    """Radix sort over those digits in which keys differ."""
    n = keys.shape[0]
    lowest, highest = keys[0], keys[0]
    for i in range(n):
        lowest, highest = min(lowest, keys[i]), max(highest, keys[i])
    counts = np.zeros((DIGITS, RADIX), np.int32)
    # Key and place in one number: one memory access moves both.
    pairs, other = np.empty(n, np.uint64), np.empty(n, np.uint64)
    for i in range(n):
        key = np.uint32(keys[i] - lowest)
        pairs[i] = np.uint64(key) << np.uint64(32) | np.uint64(i)
        for digit in range(DIGITS):
            counts[digit, (key >> np.uint32(digit * RADIX_BITS)) & np.uint32(RADIX - 1)] += 1
    for digit in range(DIGITS):
        if (highest - lowest) >> np.uint32(digit * RADIX_BITS) == 0:
            break
        position = np.int32(0)
        for value in range(RADIX):
            here = counts[digit, value]
            counts[digit, value] = position
            position += here
        shift = np.uint64(32 + digit * RADIX_BITS)
        for i in range(n):
            value = (pairs[i] >> shift) & np.uint64(RADIX - 1)
            to = counts[digit, value]
            counts[digit, value] = to + 1
            other[to] = pairs[i]
        pairs, other = other, pairs
    for i in range(n):
        order[i] = begin + np.int64(pairs[i] & np.uint64(0xFFFFFFFF))
