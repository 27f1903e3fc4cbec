"""The residual MLP of a scene that is not trained any more, on the CPU; `tensors/residual_mlp.py` is its readable twin.

    first = residuals residual_entry + shared[anchor]
    x     = leaky(first[:, :H])
    x     = x + leaky(x weights1 + biases1) weights2 + biases2        once per block
    out   = x output_weight + first[:, H:]

`H` is the hidden width, `O` the outputs, `G` the residual channels, `B` the blocks; `shared` [A, H + O] is the anchors'
part of the first layer and of the skip, biases included, computed once per anchor. Coupled primitives are taken ROWS at
a time, so that all activations of a group stay in the core's cache. Training has kernels of its own with gradients
(`tensors/residual_mlp_kernels.py`).
"""

import numpy as np

from compgs.model.constants import NEGATIVE_SLOPE
from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.products import multiply, padded

ANCHORS = 128  # in a block
ROWS = 128  # primitives in a group: all activations of a group fit into the second-level cache
TASKS = 128  # into which groups and blocks are divided at most: scratch memory is allocated once per task

SLOPE = np.float32(NEGATIVE_SLOPE)
FASTMATH = {"contract", "nsz", "arcp"}


@njit(fastmath=FASTMATH)
def add_leaky(x, bias, n):
    """x[:n] = leaky(x + bias), flat."""
    for i in range(n):
        y = x[i] + bias[i]
        x[i] = max(y, SLOPE * y)


@njit(fastmath=FASTMATH)
def add_two(x, y, bias, n):
    """x[:n] = (x + bias) + y, flat."""
    for i in range(n):
        x[i] = x[i] + bias[i] + y[i]


@njit
def tiled(biases):
    """[blocks, H] -> [blocks, ROWS * H]: a bias for each number of a group, so that adding it is one flat loop."""
    H = biases.shape[1]
    tiles = np.empty((len(biases), ROWS * H), np.float32)
    for b in range(len(biases)):
        for i in range(ROWS):
            for c in range(
                H
            ):  # not a slice: what numba would say of other shapes takes two seconds to compile
                tiles[b, i * H + c] = biases[b, c]
    return tiles


@njit(fastmath=FASTMATH)
def add_shared(first, shared, index, x):
    """first[i] += shared[index[i]]; x [n, H] = leaky(its first columns)."""
    H, F = x.shape[1], first.shape[1]
    for i in range(len(index)):
        anchor = index[i]
        for j in range(H):
            y = first[i, j] + shared[anchor, j]
            x[i, j] = max(y, SLOPE * y)
        for j in range(H, F):
            first[i, j] += shared[anchor, j]


@njit(inline="always")
def chosen_rows(residuals, rows, p, q, scratch):
    """Residuals of a group: a part of the array, or gathered."""
    if len(rows) == 0:
        return residuals[p:q]
    for i in range(q - p):
        for c in range(residuals.shape[1]):
            scratch[i, c] = residuals[rows[p + i], c]
    return scratch[: q - p]


@njit(fastmath=FASTMATH)
def hidden_layers(residuals, index, shared, residual_entry, weights1, tiles1, weights2, tiles2, first, x, h):
    """One group: fills the last O columns of first [n, H + O], x [blocks + 1, ROWS, H] and h [ROWS, H]."""
    n, H = residuals.shape[0], weights1.shape[2]
    multiply(residuals, residual_entry, first)
    add_shared(first, shared, index, x[0])
    for b in range(weights1.shape[0]):
        multiply(x[b, :n], weights1[b], h[:n])
        add_leaky(h.ravel(), tiles1[b], n * H)
        multiply(h[:n], weights2[b], x[b + 1, :n])
        add_two(x[b + 1].ravel(), x[b].ravel(), tiles2[b], n * H)


@njit(parallel=True)
def begin(
    features,  # [A, F] float32, of anchors
    anchor_entry,  # [F, H + O]
    entry_bias,  # [H + O]
    shared,  # [A, H + O], written
    part,
):
    """The anchors' part of the first layer and of the skip, biases included."""
    for block in chunk_of((len(features) + ANCHORS - 1) // ANCHORS, part):
        first, last = block * ANCHORS, min(len(features), (block + 1) * ANCHORS)
        begin_block(features[first:last], anchor_entry, entry_bias, shared[first:last])


@njit
def begin_block(features, anchor_entry, entry_bias, shared):
    """`begin` of one block of anchors."""
    multiply(features, anchor_entry, shared)
    for i in range(len(features)):
        for c in range(len(entry_bias)):
            shared[i, c] += entry_bias[c]


@njit(parallel=True)
def forward(
    residuals,  # [P, G] float32
    rows,  # [M] int64, ascending: those that are computed; [0]: all, M = P
    index,  # [M] int64: row of shared, ascending
    shared,  # [A, H + O] float32: the anchor's part of the first layer and of the skip, biases included
    residual_entry,  # [G, H + O], and so on: of `MLPArrays`
    weights1,
    biases1,
    weights2,
    biases2,
    output_weight,
    out,  # [M, O], written
    part,
):
    M, G, blocks = len(index), len(residual_entry), len(weights1)
    H, O = output_weight.shape
    groups = (M + ROWS - 1) // ROWS
    tasks = min(groups, TASKS)
    tiles1, tiles2 = tiled(biases1), tiled(biases2)
    wide_weight = padded(output_weight)
    for t in chunk_of(tasks, part):
        own = np.empty((ROWS, G), np.float32)
        wide = np.empty((ROWS, wide_weight.shape[1]), np.float32)
        first = np.empty((ROWS, H + O), np.float32)
        x = np.empty((blocks + 1, ROWS, H), np.float32)
        h = np.empty((ROWS, H), np.float32)
        for g in range(groups * t // tasks, groups * (t + 1) // tasks):
            p, q = g * ROWS, min(M, (g + 1) * ROWS)
            n = q - p
            taken = chosen_rows(residuals, rows, p, q, own)
            hidden_layers(
                taken, index[p:q], shared, residual_entry, weights1, tiles1, weights2, tiles2, first[:n], x, h
            )
            multiply(x[blocks, :n], wide_weight, wide[:n])
            for i in range(n):
                for j in range(O):
                    out[p + i, j] = wide[i, j] + first[i, H + j]
