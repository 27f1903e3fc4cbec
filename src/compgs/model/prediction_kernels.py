"""Sec. 3.2 on the CPU, on numpy arrays: activations, cutoff, affine map and view embedding. Its readable twin is
`tensors/prediction.py`; training and rendering both compute by the few functions at the top.

    anchors in view ──► [f, v] times the anchors' weights ─┐
    residuals g ───────────────────────────────────────────┴─► network ──► opacity, color ──► those drawn, with geometry

Written out in torch, everything around the networks (gathers, activations, copies) costs more than the networks
themselves. For a view (`paired_appearance`) anchors are taken ANCHORS at a time and their primitives ROWS at a time, so
that what belongs together stays in the core's cache; results are written twice, first to where they would be if all
primitives were drawn, then side by side. Blocks are fixed: no result depends on the number of threads.
"""

import math

import numpy as np

from compgs.model.constants import OPACITY_CUTOFF, SMALLEST_DISTANCE
from compgs.model.network_kernels import ANCHORS, ROWS, TASKS, begin_block, hidden_layers, tiled
from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.products import multiply

_FASTMATH = {"contract", "nsz", "arcp"}
_f32 = np.float32
_ZERO, _HALF, _ONE, _TWO = _f32(0), _f32(0.5), _f32(1), _f32(2)
CUTOFF, _SMALLEST_DISTANCE = _f32(OPACITY_CUTOFF), _f32(SMALLEST_DISTANCE)
_LOG2_E, _LN_2 = _f32(1 / math.log(2)), _f32(math.log(2))
_LARGEST_EXPONENT = _f32(126)
# Taylor series of exp on +-ln(2)/2: the first term left out is 1.2e-7
_C2, _C3, _C4, _C5, _C6 = (_f32(1 / math.factorial(k)) for k in range(2, 7))


# one number, one primitive ---------------------------------------------------------------------------------


@njit(inline="always")
def sigmoid(x):
    """1 / (1 + exp(-x)), vectorizable; absolute error below 2e-7."""
    t = min(max(-_LOG2_E * x, -_LARGEST_EXPONENT), _LARGEST_EXPONENT)
    whole = np.floor(t + _HALF)
    f = (t - whole) * _LN_2
    p = _ONE + f * (_ONE + f * (_C2 + f * (_C3 + f * (_C4 + f * (_C5 + f * _C6)))))
    return _ONE / (_ONE + p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32))


@njit(inline="always")
def opacity_of_sigmoid(s):
    """tanh(x) of s = sigmoid(2 x)."""
    return _TWO * s - _ONE


@njit(inline="always")
def is_drawn(opacity):
    """Whether a primitive reaches the renderer."""
    return opacity > CUTOFF


@njit(inline="always")
def _sigmoids(flat, n):
    """flat[:n] = its sigmoid: side by side, so that they are computed in vector registers."""
    for i in range(n):
        flat[i] = sigmoid(flat[i])


# all primitives: each kernel fills its last arguments ---------------------------------------------------------------


@njit(parallel=True, fastmath=_FASTMATH)
def activate_opacities(
    raw,  # [P, C] of the opacity or the appearance network: opacity comes first
    opacities,  # [P]
    part,
):
    for block in chunk_of((len(raw) + ROWS - 1) // ROWS, part):
        first, last = block * ROWS, min(len(raw), (block + 1) * ROWS)
        for i in range(first, last):
            opacities[i] = _TWO * raw[i, 0]
        _sigmoids(opacities[first:last], last - first)
        for i in range(first, last):
            opacities[i] = opacity_of_sigmoid(opacities[i])


@njit(parallel=True, fastmath=_FASTMATH)
def activate_colors(
    raw,  # [P, C] of the color or the appearance network: color comes last
    rows,  # [M] int64: those to activate
    colors,  # [M, 3] display RGB
    part,
):
    m, first_channel = len(rows), raw.shape[1] - 3
    for block in chunk_of((m + ROWS - 1) // ROWS, part):
        first, last = block * ROWS, min(m, (block + 1) * ROWS)
        for j in range(first, last):
            for c in range(3):
                colors[j, c] = raw[rows[j], first_channel + c]
        _sigmoids(colors[first:last].ravel(), 3 * (last - first))


@njit(parallel=True, fastmath=_FASTMATH)
def affine_transform(
    raw,  # [M, 10] of the geometry network: translation, scaling, quaternion
    anchor,  # [M] int64: anchor of each primitive
    positions,  # [A, 3] of the anchors, world units
    spread,  # [A, 6] world units: (0:3) reach of a translation of 1, (3:6) size
    means,  # [M, 3] world units
    scales,  # [M, 3] world units
    quaternions,  # [M, 4] w-x-y-z, not normalized
    part,
):
    m = len(raw)
    for block in chunk_of((m + ROWS - 1) // ROWS, part):
        first, last = block * ROWS, min(m, (block + 1) * ROWS)
        bounded = np.zeros((ROWS, 3), np.float32)
        for j in range(first, last):
            for c in range(3):
                bounded[j - first, c] = raw[j, 3 + c]
        _sigmoids(bounded.ravel(), 3 * ROWS)
        for j in range(first, last):
            a = anchor[j]
            for c in range(3):
                means[j, c] = positions[a, c] + raw[j, c] * spread[a, c]
                scales[j, c] = spread[a, 3 + c] * bounded[j - first, c]
            quaternions[j, 0] = raw[j, 6] + _ONE
            for c in range(1, 4):
                quaternions[j, c] = raw[j, 6 + c]


@njit(parallel=True, fastmath=_FASTMATH)
def activation_gradients(
    opacities,  # [M], and so on: what `activate_...` and `affine_transform` gave
    colors,
    translations,  # [M, 3]: of `raw`
    scales,
    spread,
    anchor,  # [M] int64, ascending
    d_means,  # [M, 3], and so on: the gradients by what they gave
    d_scales,
    d_quaternions,
    d_opacities,
    d_colors,
    bounds,  # [chunks + 1] from `chunk_bounds`
    d_appearance,  # [M, 4] by raw opacity and color
    d_geometry,  # [M, 10]
    d_log_scales,  # [A, 6] added to
    part,
):
    for chunk in chunk_of(len(bounds) - 1, part):
        for j in range(bounds[chunk], bounds[chunk + 1]):
            a = anchor[j]
            d_appearance[j, 0] = d_opacities[j] * (_ONE - opacities[j] * opacities[j])
            for c in range(3):
                d_appearance[j, 1 + c] = d_colors[j, c] * colors[j, c] * (_ONE - colors[j, c])
                moved = d_means[j, c] * spread[a, c]
                d_geometry[j, c] = moved
                d_log_scales[a, c] += moved * translations[j, c]
                grown = d_scales[j, c] * scales[j, c]
                d_geometry[j, 3 + c] = grown * (_ONE - scales[j, c] / spread[a, 3 + c])
                d_log_scales[a, 3 + c] += grown
            for c in range(4):
                d_geometry[j, 6 + c] = d_quaternions[j, c]


# what a camera sees ---------------------------------------------------------------------------------


@njit(parallel=True)
def see(
    anchors,  # [V] int64: those in view
    positions,  # [N, 3] world units
    references,  # [N, D]
    center,  # [3] of the camera, world units
    distance_unit,  # world units
    seen,  # [V, D + 4]: reference embedding, view embedding
    part,
):
    for block in chunk_of((len(anchors) + ANCHORS - 1) // ANCHORS, part):
        first, last = block * ANCHORS, min(len(anchors), (block + 1) * ANCHORS)
        _see_block(anchors[first:last], positions, references, center, distance_unit, seen[first:last])


@njit(fastmath=_FASTMATH, error_model="numpy")
def _see_block(anchors, positions, references, center, distance_unit, seen):
    D = references.shape[1]
    for i in range(len(anchors)):
        a = anchors[i]
        for c in range(D):
            seen[i, c] = references[a, c]
        x, y, z = positions[a, 0] - center[0], positions[a, 1] - center[1], positions[a, 2] - center[2]
        distance = np.sqrt(x * x + y * y + z * z)
        inverse = _ONE / max(distance, _SMALLEST_DISTANCE)
        seen[i, D], seen[i, D + 1], seen[i, D + 2] = x * inverse, y * inverse, z * inverse
        seen[i, D + 3] = distance / distance_unit


@njit(parallel=True)
def gather_geometry(
    index,  # [M] int64: those wanted
    means,  # [P, 3], and so on: of all
    scales,
    quaternions,
    drawn_means,  # [M, 3], and so on, written
    drawn_scales,
    drawn_quaternions,
    part,
):
    for block in chunk_of((len(index) + ROWS - 1) // ROWS, part):
        for j in range(block * ROWS, min(len(index), (block + 1) * ROWS)):
            p = index[j]
            for c in range(3):
                drawn_means[j, c] = means[p, c]
                drawn_scales[j, c] = scales[p, c]
            for c in range(4):
                drawn_quaternions[j, c] = quaternions[p, c]


def block_count(anchors: int) -> int:
    return -(-anchors // ANCHORS)


@njit(parallel=True, fastmath=_FASTMATH, error_model="numpy")
def paired_appearance(
    anchors,  # [V] int64, ascending: those in view
    first_coupled,  # [N + 1] int64: first coupled primitive of each anchor
    places,  # [V + 1] int64: where the results of each anchor in view begin
    positions,  # [N, 3] world units
    references,  # [N, D]
    residuals,  # [P, G]
    center,  # [3] of the camera, world units
    distance_unit,  # world units
    anchor_entry,  # [D + 4, H + 4], and so on: of `MLPArrays`
    entry_bias,
    residual_entry,
    weights1,
    biases1,
    weights2,
    biases2,
    output_weight,
    appearance,  # [places[V], 4], written: opacity (0: not drawn) and color
    drawn,  # [blocks] int64, written: primitives of each block that are drawn
    part,
):
    V, D, G, H = len(anchors), references.shape[1], residuals.shape[1], len(output_weight)
    blocks, layers = len(drawn), len(weights1)
    tasks = min(blocks, TASKS)
    tiles1, tiles2 = tiled(biases1), tiled(biases2)
    for t in chunk_of(tasks, part):
        seen = np.empty((ANCHORS, D + 4), np.float32)
        shared = np.empty((ANCHORS, H + 4), np.float32)
        own = np.empty((ROWS, G), np.float32)
        row = np.empty(ROWS, np.int64)
        first = np.empty((ROWS, H + 4), np.float32)
        x = np.empty((layers + 1, ROWS, H), np.float32)
        h = np.empty((ROWS, H), np.float32)
        for block in range(blocks * t // tasks, blocks * (t + 1) // tasks):
            v0, v1 = block * ANCHORS, min(V, (block + 1) * ANCHORS)
            _see_block(anchors[v0:v1], positions, references, center, distance_unit, seen)
            begin_block(seen[: v1 - v0], anchor_entry, entry_bias, shared[: v1 - v0])
            count = 0
            v, place = v0, places[v0]
            while place < places[v1]:
                n = min(ROWS, places[v1] - place)
                for i in range(n):
                    while places[v + 1] <= place + i:
                        v += 1
                    p = first_coupled[anchors[v]] + place + i - places[v]
                    row[i] = v - v0
                    for c in range(G):
                        own[i, c] = residuals[p, c]
                hidden_layers(
                    own[:n],
                    row[:n],
                    shared,
                    residual_entry,
                    weights1,
                    tiles1,
                    weights2,
                    tiles2,
                    first[:n],
                    x,
                    h,
                )
                out = appearance[place : place + n]
                multiply(x[layers, :n], output_weight, out)
                count += _activate(out, first, H)
                place += n
            drawn[block] = count


@njit(fastmath=_FASTMATH, error_model="numpy")
def _activate(out, first, H):
    """Adds the skip to out [n, 4] and activates it in place; returns how many primitives are drawn."""
    n = len(out)
    for i in range(n):
        out[i, 0] = _TWO * (out[i, 0] + first[i, H])
        for c in range(1, 4):
            out[i, c] += first[i, H + c]
    _sigmoids(out.ravel(), 4 * n)
    count = 0
    for i in range(n):
        opacity = opacity_of_sigmoid(out[i, 0])
        shown = is_drawn(opacity)
        out[i, 0] = opacity if shown else _ZERO
        count += shown
    return count


@njit(parallel=True)
def gather_drawn(
    anchors, first_coupled, places, appearance, offsets,
    means, scales, quaternions,
    index, drawn_means, drawn_scales, drawn_quaternions, opacities, colors,
    part,
):  # fmt: skip
    """Fills the arrays of the drawn primitives and which they are; `offsets` [blocks + 1] int64: where each block's
    begin.
    """
    for block in chunk_of(len(offsets) - 1, part):
        to = offsets[block]
        for v in range(block * ANCHORS, min(len(anchors), (block + 1) * ANCHORS)):
            shift = first_coupled[anchors[v]] - places[v]
            for place in range(places[v], places[v + 1]):
                if appearance[place, 0] == _ZERO:
                    continue
                p = place + shift
                index[to] = p
                opacities[to] = appearance[place, 0]
                for c in range(3):
                    colors[to, c] = appearance[place, 1 + c]
                    drawn_means[to, c] = means[p, c]
                    drawn_scales[to, c] = scales[p, c]
                for c in range(4):
                    drawn_quaternions[to, c] = quaternions[p, c]
                to += 1
