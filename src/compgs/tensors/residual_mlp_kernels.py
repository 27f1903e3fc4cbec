"""The residual MLP in training, on the CPU, fused: backward, with recomputation. `residual_mlp.py` is its
readable twin, and explains the equations with `model/network_kernels.py`, the kernels of rendering.

Coupled primitives are taken ROWS at a time, so that all activations of a group stay in the core's cache; the products
are `numerics/products.py`. Nothing is kept for the backward pass but the inputs: the activations are computed again,
group by group.

Gradients of the weights are sums over all primitives: they are accumulated in CHUNKS parts and then added in
order. Parts end where an anchor ends, so that each anchor's gradient is summed by one thread. The result
depends on neither the number of threads nor their timing.
"""

import numpy as np

from compgs.model.network_kernels import (
    FASTMATH,
    ROWS,
    SLOPE,
    add_leaky,
    add_shared,
    add_two,
    chosen_rows,
    tiled,
)
from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.products import add_product, multiply, padded

CHUNKS = 16  # partial sums of a weight gradient


@njit(fastmath=FASTMATH)
def _leaky_gradient(d, x, n):
    """d[:n] *= the slope where the activation x was negative; leaky keeps the sign, so its output tells."""
    for i in range(n):
        d[i] = d[i] if x[i] > np.float32(0) else SLOPE * d[i]


@njit(fastmath=FASTMATH)
def activations(residuals, index, shared, residual_entry, weights1, tiles1, weights2, tiles2, first, x, h):
    """One group: fills the last O columns of first [n, H + O], x [blocks + 1, ROWS, H] and h [blocks, ROWS, H]."""
    n, H = residuals.shape[0], weights1.shape[2]
    multiply(residuals, residual_entry, first)
    add_shared(first, shared, index, x[0])
    for b in range(weights1.shape[0]):
        multiply(x[b, :n], weights1[b], h[b, :n])
        add_leaky(h[b].ravel(), tiles1[b], n * H)
        multiply(h[b, :n], weights2[b], x[b + 1, :n])
        add_two(x[b + 1].ravel(), x[b].ravel(), tiles2[b], n * H)


@njit
def rows_with_gradient(d_out):
    """[R] int64, ascending: the rows of d_out [M, O] that are not all zero: what the backward pass needs."""
    rows = np.empty(len(d_out), np.int64)
    count = 0
    for i in range(len(d_out)):
        for j in range(d_out.shape[1]):
            if d_out[i, j] != np.float32(0):
                rows[count] = i
                count += 1
                break
    return rows[:count].copy()


@njit
def chunk_bounds(index, chunks):
    """[chunks + 1] rows of equal parts, moved forward to where the next anchor begins."""
    M = len(index)
    bounds = np.zeros(chunks + 1, np.int64)
    for c in range(1, chunks + 1):
        row = max(M * c // chunks, bounds[c - 1])
        while 0 < row < M and index[row] == index[row - 1]:
            row += 1
        bounds[c] = row
    return bounds


@njit(fastmath=FASTMATH)
def _first_gradient(first, dx, x, d, index, d_shared):
    """first [n, H + O] becomes its own gradient: from dx, of x = leaky(first[:, :H]), and d, of first[:, H:]. Each row
    is added to its anchor's in d_shared.
    """
    H, O = x.shape[1], d.shape[1]
    for i in range(len(d)):
        anchor = index[i]
        for j in range(H):
            first[i, j] = dx[i, j] if x[i, j] > np.float32(0) else SLOPE * dx[i, j]
        for j in range(O):
            first[i, H + j] = d[i, j]
        if len(d_shared) > 0:
            for j in range(H + O):
                d_shared[anchor, j] += first[i, j]


@njit(parallel=True)
def backward(
    residuals,
    rows,
    index,
    shared,
    residual_entry,
    weights1,
    biases1,
    weights2,
    biases2,
    output_weight,
    d_out,  # [M, O]
    bounds,  # [chunks + 1] from chunk_bounds
    d_residuals,  # [P, G] added to; [0, G] if not wanted
    d_shared,  # [A, H + O] added to; [0, H + O] if not wanted
    # [chunks, size] zero, written: residual entry, per block weight 1, bias 1, weight 2, bias 2, then output weight;
    # [chunks, 0] if not wanted
    d_weights,
    part,
):
    G, blocks = len(residual_entry), len(weights1)
    H, O = output_weight.shape
    F = H + O
    want_residuals, want_weights = len(d_residuals) > 0, d_weights.shape[1] > 0
    # Columns of a right factor must lie side by side.
    entry_t, output_t = np.ascontiguousarray(residual_entry.T), np.ascontiguousarray(output_weight.T)
    weights1_t, weights2_t = np.empty_like(weights1), np.empty_like(weights2)
    for b in range(blocks):
        for i in range(H):
            for j in range(H):
                weights1_t[b, j, i], weights2_t[b, j, i] = weights1[b, i, j], weights2[b, i, j]
    tiles1, tiles2 = tiled(biases1), tiled(biases2)
    wide = padded(output_weight).shape[1]
    for c in chunk_of(len(bounds) - 1, part):
        own = np.empty((ROWS, G), np.float32)
        first = np.empty((ROWS, F), np.float32)
        x = np.empty((blocks + 1, ROWS, H), np.float32)
        h = np.empty((blocks, ROWS, H), np.float32)
        dx = np.empty((ROWS, H), np.float32)
        dh = np.empty((ROWS, H), np.float32)
        d_taken = np.empty((ROWS, G), np.float32)
        ones = np.ones((1, ROWS), np.float32)
        weights = d_weights[c]
        wide_d, wide_weights = np.zeros((ROWS, wide), np.float32), np.zeros((H, wide), np.float32)
        output = G * F + blocks * 2 * (H * H + H)  # where the output weight's begin
        for p in range(bounds[c], bounds[c + 1], ROWS):
            q = min(bounds[c + 1], p + ROWS)
            n = q - p
            taken = chosen_rows(residuals, rows, p, q, own)
            activations(
                taken, index[p:q], shared, residual_entry, weights1, tiles1, weights2, tiles2, first[:n], x, h
            )
            d = d_out[p:q]
            multiply(d, output_t, dx[:n])
            at = output
            if want_weights:
                for i in range(n):
                    for j in range(O):
                        wide_d[i, j] = d[i, j]
                add_product(x[blocks, :n].T, wide_d[:n], wide_weights)
            for b in range(blocks - 1, -1, -1):
                at -= 2 * (H * H + H)
                multiply(dx[:n], weights2_t[b], dh[:n])
                _leaky_gradient(dh.ravel(), h[b].ravel(), n * H)
                if want_weights:
                    second = at + H * H + H
                    add_product(x[b, :n].T, dh[:n], weights[at : at + H * H].reshape(H, H))
                    add_product(ones[:, :n], dh[:n], weights[at + H * H : second].reshape(1, H))
                    add_product(h[b, :n].T, dx[:n], weights[second : second + H * H].reshape(H, H))
                    add_product(
                        ones[:, :n], dx[:n], weights[second + H * H : second + H * H + H].reshape(1, H)
                    )
                add_product(dh[:n], weights1_t[b], dx[:n])
            _first_gradient(first, dx, x[0], d, index[p:q], d_shared)
            if want_weights:
                add_product(taken.T, first[:n], weights[: G * F].reshape(G, F))
            if want_residuals and len(rows) == 0:
                add_product(first[:n], entry_t, d_residuals[p:q])
            elif want_residuals:
                multiply(first[:n], entry_t, d_taken[:n])
                for i in range(n):
                    for j in range(G):
                        d_residuals[rows[p + i], j] += d_taken[i, j]
        if want_weights:
            for i in range(H):
                for j in range(O):
                    weights[output + i * O + j] = wide_weights[i, j]
