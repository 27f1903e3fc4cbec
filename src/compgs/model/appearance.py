"""What a camera sees of a decoded scene, on the CPU, without gradients (CompGS Sec. 3.2).

    anchors in view ──► [f, v] times the anchors' weights ─┐
    residuals g ───────────────────────────────────────────┴─► network ──► opacity, color ──► those drawn, with geometry

The plain torch of `HybridModel` is what the tests compare it with. Written out in torch, everything around the network
(gathers, activations, copies) costs more than the network itself. Here anchors are taken ANCHORS at a time and their
primitives ROWS at a time, so that what belongs together stays in the core's cache; results are written twice, first to
where they would be if all primitives were drawn, then side by side. Blocks are fixed: the result does not depend on
the number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from compgs.model.residual_mlp import CHUNKS, ROWS, activations, tiled

ANCHORS = 128  # in a block

_FASTMATH = {"contract", "nsz", "arcp"}
_f32 = np.float32
_ZERO, _HALF, _ONE, _TWO = _f32(0), _f32(0.5), _f32(1), _f32(2)
_LOG2_E, _LN_2 = _f32(1 / math.log(2)), _f32(math.log(2))
_LARGEST_EXPONENT = _f32(126)
# Taylor series of exp on +-ln(2)/2: the first term left out is 1.2e-7
_C2, _C3, _C4, _C5, _C6 = (_f32(1 / math.factorial(k)) for k in range(2, 7))


def block_count(anchors: int) -> int:
    return -(-anchors // ANCHORS)


@njit(inline="always")
def sigmoid(x):
    """1 / (1 + exp(-x)), vectorizable; absolute error below 2e-7."""
    t = min(max(-_LOG2_E * x, -_LARGEST_EXPONENT), _LARGEST_EXPONENT)
    whole = np.floor(t + _HALF)
    f = (t - whole) * _LN_2
    p = _ONE + f * (_ONE + f * (_C2 + f * (_C3 + f * (_C4 + f * (_C5 + f * _C6)))))
    return _ONE / (_ONE + p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32))


@njit(parallel=True, fastmath=_FASTMATH, error_model="numpy", cache=True)
def predict_appearance(
    anchors,  # [V] int64, ascending: those in view
    first_coupled,  # [N + 1] int64: first coupled primitive of each anchor
    places,  # [V + 1] int64: where the results of each anchor in view begin
    positions,  # [N, 3] world units
    references,  # [N, D]
    residuals,  # [P, G]
    center,  # [3] of the camera, world units
    distance_unit,  # world units
    cutoff,  # opacity that a primitive must exceed to be drawn
    A,  # [D + 4, H + 4]: what the first layer and the skip make of an anchor, and their biases
    bias,  # [H + 4]
    R,  # [G, H + 4], and so on: see residual_mlp
    V1,
    a1,
    V2,
    a2,
    U,
    appearance,  # [places[V], 4], written: opacity (0: not drawn) and color
    drawn,  # [blocks] int64, written: primitives of each block that are drawn
):
    V, D, G, H, blocks = len(anchors), references.shape[1], residuals.shape[1], len(U), len(drawn)
    # Several blocks to a task: scratch memory is allocated once per task.
    tasks = min(blocks, 8 * CHUNKS)
    tiles1, tiles2 = tiled(a1), tiled(a2)
    for t in prange(tasks):
        seen = np.empty((ANCHORS, D + 4), np.float32)
        shared = np.empty((ANCHORS, H + 4), np.float32)
        own = np.empty((ROWS, G), np.float32)
        row = np.empty(ROWS, np.int64)
        first = np.empty((ROWS, H + 4), np.float32)
        x = np.empty((len(V1) + 1, ROWS, H), np.float32)
        h = np.empty((len(V1), ROWS, H), np.float32)
        for block in range(blocks * t // tasks, blocks * (t + 1) // tasks):
            v0, v1 = block * ANCHORS, min(V, (block + 1) * ANCHORS)
            see_anchors(anchors[v0:v1], positions, references, center, distance_unit, seen)
            np.dot(seen[: v1 - v0], A, shared[: v1 - v0])
            for i in range(v1 - v0):
                for c in range(H + 4):
                    shared[i, c] += bias[c]
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
                activations(own[:n], row[:n], shared, R, V1, tiles1, V2, tiles2, first[:n], x, h)
                out = appearance[place : place + n]
                np.dot(x[len(V1), :n], U, out)
                count += activate(out, first, H, cutoff)
                place += n
            drawn[block] = count


@njit(fastmath=_FASTMATH, error_model="numpy", cache=True)
def see_anchors(anchors, positions, references, center, distance_unit, seen):
    """Fills rows of `seen`: reference embedding, direction from the camera, distance."""
    D = references.shape[1]
    for i in range(len(anchors)):
        a = anchors[i]
        for c in range(D):
            seen[i, c] = references[a, c]
        x, y, z = positions[a, 0] - center[0], positions[a, 1] - center[1], positions[a, 2] - center[2]
        distance = np.sqrt(x * x + y * y + z * z)
        inverse = _ONE / max(distance, _f32(1e-12))
        seen[i, D], seen[i, D + 1], seen[i, D + 2] = x * inverse, y * inverse, z * inverse
        seen[i, D + 3] = distance / distance_unit


@njit(fastmath=_FASTMATH, error_model="numpy", cache=True)
def activate(out, first, H, cutoff):
    """Adds the skip to out [n, 4] and activates it in place; returns how many primitives are drawn."""
    n = len(out)
    for i in range(n):
        # tanh(x) = 2 sigmoid(2 x) - 1
        out[i, 0] = _TWO * (out[i, 0] + first[i, H])
        for c in range(1, 4):
            out[i, c] += first[i, H + c]
    flat = out.ravel()
    for j in range(4 * n):
        flat[j] = sigmoid(flat[j])
    count = 0
    for i in range(n):
        opacity = _TWO * out[i, 0] - _ONE
        shown = opacity > cutoff
        out[i, 0] = opacity if shown else _ZERO
        count += shown
    return count


@njit(parallel=True, cache=True)
def gather_drawn(
    anchors, first_coupled, places, appearance, offsets,
    means, scales, quaternions,
    drawn_means, drawn_scales, drawn_quaternions, opacities, colors,
):  # fmt: skip
    """Fills the arrays of the drawn primitives; `offsets` [blocks + 1] int64: where each block's begin."""
    for block in prange(len(offsets) - 1):
        to = offsets[block]
        for v in range(block * ANCHORS, min(len(anchors), (block + 1) * ANCHORS)):
            shift = first_coupled[anchors[v]] - places[v]
            for place in range(places[v], places[v + 1]):
                if appearance[place, 0] == _ZERO:
                    continue
                p = place + shift
                opacities[to] = appearance[place, 0]
                for c in range(3):
                    colors[to, c] = appearance[place, 1 + c]
                    drawn_means[to, c] = means[p, c]
                    drawn_scales[to, c] = scales[p, c]
                for c in range(4):
                    drawn_quaternions[to, c] = quaternions[p, c]
                to += 1
