"""Alpha blending of tiles on the CPU, forward and backward.

A tile is 8 x 32 pixels: its rows fill a vector register, and small splats fill such rows better than wider
ones. For every entry of a tile, front to back, and every pixel of its rows:

    q = |L^T d|^2 - log2 opacity     alpha = 2^-q   (0 below the cutoff, at most the cap)
    color += alpha T color_i         T <- T (1 - alpha)

The sign of T marks a finished pixel. The backward pass runs front to back as well: it carries what is still
to come, D = sum over the splats behind of (color . gradient) weight, and
dL/dalpha = T (color . gradient) - D / (1 - alpha). Gradients of a splat are written once per tile and summed
per splat afterwards, always in the same order: no atomics, and the same bits with any number of threads.

For the compiler to vectorize, indices are unsigned, the scratch is one buffer of planes with constant
offsets, and the loops over pixels are flat. Losing it costs a factor of ten and is silent: a test looks for
vector instructions. A plane per coordinate costs less than conversions of the loop's index, and sums as local
variables (rather than in the buffer) spare the compiled code a check for overlaps at every entry.

What is done at a pixel is one long chain of operations, each of which waits for the one before. So an entry's pixels
are gone through two or three times, with a link of the chain each time: then the processor works at several rows at
once. That and a scratch that begins where a cache line does save a seventh of the forward and a quarter of the backward
pass (docs/results/rasterizer.md).
"""

import numpy as np

from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.vector_sums import add_in_any_order
from compgs.render.binning import (
    CHUNKS,
    EXP2_SCALE,
    PARAMETERS,
    TILE_HEIGHT,
    TILE_WIDTH,
    chunk_bounds,
    tile_at,
    turns,
)

FASTMATH = {"contract", "nsz", "arcp", "nnan", "ninf"}
f32 = np.float32
ZERO, HALF, ONE = f32(0), f32(0.5), f32(1)
MOMENTS = 9  # gradient sums of a splat in a tile: alpha, d (2), d d^T (3), color (3)
ENTRIES_PER_CHECK = 16  # between two tests whether a tile is finished

U = np.uint64
WIDTH = U(TILE_WIDTH)
PIXELS = U(TILE_WIDTH * TILE_HEIGHT)
# Planes of the scratch buffer. First T; then the image (forward), or its gradient (backward), and D. The last two hold
# what one loop over an entry's pixels leaves to the next: alpha, then v of `blend_backward`; the weight.
COLUMN, ROW, RED, GREEN, BLUE, BEHIND, ALPHA, WEIGHT = (U(plane) * PIXELS for plane in range(1, 9))
SCRATCH = 9 * TILE_WIDTH * TILE_HEIGHT
CACHE_LINE = 16  # float32

# 2^f on [0, 1): least maximal relative error, 1.6e-7 with float32 rounding. An error of 1e-5 would already
# flip decisions at the alpha cutoff and show in the image.
E0, E1, E2 = f32(0.9999999251), f32(0.6931530732), f32(0.2401536171)
E3, E4, E5 = f32(0.05582631792), f32(0.008989340252), f32(0.001877576608)
LARGEST_EXPONENT = f32(100)  # far below any cutoff; 2^-126 times p is no normal number, and slow


@njit(inline="always")
def exp2_minus(q):
    """2^-q for q up to 100 (beyond: 2^-100), vectorizable."""
    t = -min(q, LARGEST_EXPONENT)
    whole = np.floor(t)
    f = t - whole
    p = E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))
    return p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(inline="always")
def corner(tile, width):
    """Left column and top row of a tile of an image."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    return tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT


@njit(inline="always")
def falloff(dx, dy, l00, l10, l11, log2_opacity):
    """Alpha of a splat at a distance in pixels, before cutoff and cap."""
    p, r = l00 * dx + l10 * dy, l11 * dy
    return exp2_minus(p * p + (r * r - log2_opacity))


@njit(inline="always")
def pass_through(t, uncapped, cutoff, cap, stop):
    """Compute at a pixel of transmittance t: alpha, the weight of the splat's color, the transmittance behind the
    splat, and whether the pixel is not finished. (Of numbers alone: with an array as argument loops would not be
    vectorized.)
    """
    alpha = min(cap, uncapped)
    alpha = alpha if alpha >= cutoff else ZERO
    weight = alpha * t
    t_next = t - weight
    open_ = t_next > stop
    return alpha, weight if open_ else ZERO, t_next if open_ else -abs(t), open_


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
def blend_forward(
    packed, starts, entries, order, background, cutoff, cap, stop, image, transmittance, ends, part
):
    """Fills image [H, W, 3], transmittance [H, W] and, per tile, the entry after the last one needed."""
    height, width = transmittance.shape
    tiles = starts.shape[0] - 1
    for turn in chunk_of(turns(tiles), part):
        tile = tile_at(turn, tiles)
        if tile >= tiles:
            continue
        left, top = corner(tile, width)
        x_origin, y_origin = f32(left) + HALF, f32(top) + HALF
        s = scratch()
        splats = np.empty((ENTRIES_PER_CHECK, PARAMETERS), np.float32)
        spans = np.empty(ENTRIES_PER_CHECK, np.int32)
        start_tile(s, left, top, width, height)
        k, end = starts[tile], starts[tile + 1]
        while k < end:
            check = min(k + ENTRIES_PER_CHECK, end)
            gather_splats(packed, entries, order, k, check, splats, spans)
            for e in range(k, check):
                j = e - k
                x, y = splats[j, 0] - x_origin, splats[j, 1] - y_origin
                l00, l10, l11, log2_opacity = splats[j, 2], splats[j, 3], splats[j, 4], splats[j, 5]
                red, green, blue = splats[j, 6], splats[j, 7], splats[j, 8]
                first_row, last_row = spans[j] >> 8, spans[j] & 255
                begin, end_pixel = U(first_row) * WIDTH, U(last_row + 1) * WIDTH
                for pixel in range(begin, end_pixel):
                    dx, dy = x - s[pixel + COLUMN], y - s[pixel + ROW]
                    s[pixel + ALPHA] = falloff(dx, dy, l00, l10, l11, log2_opacity)
                for pixel in range(begin, end_pixel):
                    _, weight, s[pixel], _ = pass_through(s[pixel], s[pixel + ALPHA], cutoff, cap, stop)
                    s[pixel + RED] += weight * red
                    s[pixel + GREEN] += weight * green
                    s[pixel + BLUE] += weight * blue
            k = check
            unfinished = np.int32(
                0
            )  # a sum, which is vectorized; a maximum is not, and took a third of all time
            for i in range(PIXELS):
                unfinished += np.int32(1) if s[i] > ZERO else np.int32(0)
            if unfinished == 0:
                break
        ends[tile] = k
        for row in range(min(TILE_HEIGHT, height - top)):
            for column in range(min(TILE_WIDTH, width - left)):
                at = U(row * TILE_WIDTH + column)
                t = abs(s[at])
                image[top + row, left + column, 0] = s[at + RED] + t * background[0]
                image[top + row, left + column, 1] = s[at + GREEN] + t * background[1]
                image[top + row, left + column, 2] = s[at + BLUE] + t * background[2]
                transmittance[top + row, left + column] = t


@njit(inline="always")
def gather_splats(packed, entries, order, begin, end, splats, spans):
    """Copies the splats of some entries side by side: their cache misses overlap instead of adding up."""
    for e in range(begin, end):
        i = entries[order[e], 0]
        spans[e - begin] = entries[order[e], 1]
        for parameter in range(PARAMETERS):
            splats[e - begin, parameter] = packed[i, parameter]


@njit(inline="always")
def scratch():
    """[SCRATCH] zeros from the beginning of a cache line on; from elsewhere, some processes took half as long again."""
    room = np.zeros(SCRATCH + CACHE_LINE, np.float32)
    skip = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[skip : skip + SCRATCH]


@njit(inline="always")
def start_tile(s, left, top, width, height):
    """Pixel coordinates, and T: one inside the image, minus one (finished) beyond its edge."""
    columns, rows = width - left, height - top
    for row in range(TILE_HEIGHT):
        for column in range(TILE_WIDTH):
            pixel = U(row * TILE_WIDTH + column)
            s[pixel] = ONE if row < rows and column < columns else -ONE
            s[pixel + COLUMN] = f32(column)
            s[pixel + ROW] = f32(row)


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
def blend_backward(
    packed, starts, entries, order, ends, cutoff, cap, stop,
    image, transmittance, grad_image, grad_transmittance, moments,
    part,
):  # fmt: skip
    """Fills moments [E, MOMENTS]: for each entry the sums over its pixels that gradients are made of.

    With v = alpha dL/dalpha: v, v dx, v dy, v dx^2, v dx dy, v dy^2, then weight dL/dimage (3).
    """
    height, width = transmittance.shape
    tiles = starts.shape[0] - 1
    for turn in chunk_of(turns(tiles), part):
        tile = tile_at(turn, tiles)
        if tile >= tiles:
            continue
        left, top = corner(tile, width)
        x_origin, y_origin = f32(left) + HALF, f32(top) + HALF
        s = scratch()
        splats = np.empty((ENTRIES_PER_CHECK, PARAMETERS), np.float32)
        spans = np.empty(ENTRIES_PER_CHECK, np.int32)
        start_tile(s, left, top, width, height)
        for row in range(min(TILE_HEIGHT, height - top)):
            for column in range(min(TILE_WIDTH, width - left)):
                at = U(row * TILE_WIDTH + column)
                g0 = grad_image[top + row, left + column, 0]
                g1 = grad_image[top + row, left + column, 1]
                g2 = grad_image[top + row, left + column, 2]
                behind = g0 * image[top + row, left + column, 0] + g1 * image[top + row, left + column, 1]
                behind += g2 * image[top + row, left + column, 2]
                behind += (
                    grad_transmittance[top + row, left + column] * transmittance[top + row, left + column]
                )
                s[at + RED], s[at + GREEN], s[at + BLUE], s[at + BEHIND] = g0, g1, g2, behind
        for batch in range(starts[tile], ends[tile], ENTRIES_PER_CHECK):
            batch_end = min(batch + ENTRIES_PER_CHECK, ends[tile])
            gather_splats(packed, entries, order, batch, batch_end, splats, spans)
            for e in range(batch, batch_end):
                j = e - batch
                x, y = splats[j, 0] - x_origin, splats[j, 1] - y_origin
                l00, l10, l11, log2_opacity = splats[j, 2], splats[j, 3], splats[j, 4], splats[j, 5]
                red, green, blue = splats[j, 6], splats[j, 7], splats[j, 8]
                first_row, last_row = spans[j] >> 8, spans[j] & 255
                begin, end_pixel = U(first_row) * WIDTH, U(last_row + 1) * WIDTH
                for pixel in range(begin, end_pixel):
                    dx, dy = x - s[pixel + COLUMN], y - s[pixel + ROW]
                    s[pixel + ALPHA] = falloff(dx, dy, l00, l10, l11, log2_opacity)
                for pixel in range(begin, end_pixel):
                    uncapped = s[pixel + ALPHA]
                    alpha, weight, s[pixel], open_ = pass_through(s[pixel], uncapped, cutoff, cap, stop)
                    color_grad = s[pixel + RED] * red + s[pixel + GREEN] * green + s[pixel + BLUE] * blue
                    behind = s[pixel + BEHIND] - weight * color_grad
                    s[pixel + BEHIND] = behind
                    # Kept pixels only; a capped alpha does not change with the splat.
                    v = weight * color_grad - alpha * behind / (ONE - alpha)
                    v = v if open_ else ZERO
                    s[pixel + ALPHA] = v if uncapped <= cap else ZERO
                    s[pixel + WEIGHT] = weight
                m0 = mx = my = mxx = mxy = myy = m_red = m_green = m_blue = ZERO
                for pixel in range(begin, end_pixel):
                    dx, dy = x - s[pixel + COLUMN], y - s[pixel + ROW]
                    v, weight = s[pixel + ALPHA], s[pixel + WEIGHT]
                    v_dx, v_dy = v * dx, v * dy
                    m0 = add_in_any_order(m0, v)
                    mx = add_in_any_order(mx, v_dx)
                    my = add_in_any_order(my, v_dy)
                    mxx = add_in_any_order(mxx, v_dx * dx)
                    mxy = add_in_any_order(mxy, v_dx * dy)
                    myy = add_in_any_order(myy, v_dy * dy)
                    m_red = add_in_any_order(m_red, weight * s[pixel + RED])
                    m_green = add_in_any_order(m_green, weight * s[pixel + GREEN])
                    m_blue = add_in_any_order(m_blue, weight * s[pixel + BLUE])
                to = order[e]  # sum_moments looks for it where the entry is
                moments[to, 0] = m0
                moments[to, 1] = mx
                moments[to, 2] = my
                moments[to, 3] = mxx
                moments[to, 4] = mxy
                moments[to, 5] = myy
                moments[to, 6] = m_red
                moments[to, 7] = m_green
                moments[to, 8] = m_blue
        for e in range(ends[tile], starts[tile + 1]):
            for moment in range(MOMENTS):
                moments[order[e], moment] = ZERO


@njit(parallel=True, fastmath=FASTMATH, error_model="numpy")
def sum_moments(
    visible, packed, first_slot, slots_used, slots, moments, opacities,
    grad_means, grad_covariances, grad_opacities, grad_colors,
    part,
):  # fmt: skip
    """Adds up each splat's tiles, and turns moments into gradients.

    With X = cov^-1 and alpha = opacity exp(-d^T X d / 2): dL/dmean = -X sum(v d), dL/dcov = X sum(v d d^T) X
    / 2.
    """
    for chunk in chunk_of(CHUNKS, part):
        begin, end = chunk_bounds(chunk, visible.shape[0])
        for i in range(begin, end):
            if not visible[i]:
                grad_means[i, :] = ZERO
                grad_covariances[i, :] = ZERO
                grad_opacities[i] = ZERO
                grad_colors[i, :] = ZERO
                continue
            m0 = mx = my = mxx = mxy = myy = red = green = blue = ZERO
            for slot in range(first_slot[i], first_slot[i] + slots_used[i]):
                e = slots[slot]
                m0 += moments[e, 0]
                mx += moments[e, 1]
                my += moments[e, 2]
                mxx += moments[e, 3]
                mxy += moments[e, 4]
                myy += moments[e, 5]
                red += moments[e, 6]
                green += moments[e, 7]
                blue += moments[e, 8]
            # X = L L^T, with the scale of the packed factor taken out
            l00, l10, l11 = packed[i, 2] / EXP2_SCALE, packed[i, 3] / EXP2_SCALE, packed[i, 4] / EXP2_SCALE
            # moments in whitened coordinates w = L^T d first: fewer digits cancel for long thin splats
            wx, wy = l00 * mx + l10 * my, l11 * my
            wxx = l00 * l00 * mxx + f32(2) * l00 * l10 * mxy + l10 * l10 * myy
            wxy, wyy = l11 * (l00 * mxy + l10 * myy), l11 * l11 * myy
            grad_means[i, 0] = -l00 * wx
            grad_means[i, 1] = -(l10 * wx + l11 * wy)
            grad_covariances[i, 0] = HALF * l00 * l00 * wxx
            grad_covariances[i, 1] = l00 * (l10 * wxx + l11 * wxy)
            grad_covariances[i, 2] = HALF * (l10 * l10 * wxx + f32(2) * l10 * l11 * wxy + l11 * l11 * wyy)
            grad_opacities[i] = m0 / opacities[i]
            grad_colors[i, 0] = red
            grad_colors[i, 1] = green
            grad_colors[i, 2] = blue
