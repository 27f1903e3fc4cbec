"""The residual MLP on the CPU, fused: forward, and backward with recomputation.

    first = residuals R + shared[anchor]            R [G, H + O]; shared [A, H + O], computed once per anchor
    x     = leaky(first[:, :H])
    x     = x + leaky(x V1 + a1) V2 + a2            once per block
    out   = x U + first[:, H:]

`H` is the hidden width, `O` the outputs, `G` the residual channels. Coupled primitives are taken ROWS at a
time, so that all activations of a group stay in the core's cache; the products are BLAS calls on such groups
(a whole pass takes 0.55 to 0.6 of the time of the same sums as loops vectorized by LLVM). Nothing is kept for
the backward pass but the inputs: the activations are computed again, group by group.

Gradients of the weights are sums over all primitives: they are accumulated in CHUNKS parts and then added in
order. Parts end where an anchor ends, so that each anchor's gradient is summed by one thread. The result
depends on neither the number of threads nor their timing.
"""

import numpy as np
from numba import njit, prange

# A power of two, as in the entropy networks.
NEGATIVE_SLOPE = 2.0**-6
ROWS = 128  # primitives in a group: all activations of a group fit into the second-level cache
CHUNKS = 16  # partial sums of a weight gradient

_SLOPE = np.float32(NEGATIVE_SLOPE)
_FASTMATH = {"contract", "nsz", "arcp"}


@njit(fastmath=_FASTMATH, cache=True)
def _leaky(x, n):
    """x[:n] = max(x, slope x), x flat."""
    for i in range(n):
        x[i] = max(x[i], _SLOPE * x[i])


@njit(fastmath=_FASTMATH, cache=True)
def _leaky_gradient(d, x, n):
    """d[:n] *= the slope where the activation x was negative; leaky keeps the sign, so its output tells."""
    for i in range(n):
        d[i] = d[i] if x[i] > np.float32(0) else _SLOPE * d[i]


@njit(fastmath=_FASTMATH, cache=True)
def _add(x, y, n):
    """x[:n] += y[:n], flat."""
    for i in range(n):
        x[i] += y[i]


@njit(fastmath=_FASTMATH, cache=True)
def _add_bias(x, bias, rows):
    for i in range(rows):
        for j in range(bias.shape[0]):
            x[i, j] += bias[j]


@njit(fastmath=_FASTMATH, cache=True)
def _add_rows(total, d, rows):
    """total[j] += sum over rows of d[:, j]."""
    for i in range(rows):
        for j in range(total.shape[0]):
            total[j] += d[i, j]


@njit(fastmath=_FASTMATH, cache=True)
def activations(residuals, index, shared, R, V1, a1, V2, a2, first, x, h):
    """One group: fills first [n, H + O], x [blocks + 1, ROWS, H] and h [blocks, ROWS, H]."""
    n, H = residuals.shape[0], V1.shape[2]
    np.dot(residuals, R, first)
    for i in range(n):
        anchor = index[i]
        for j in range(first.shape[1]):
            first[i, j] += shared[anchor, j]
    for i in range(n):
        for j in range(H):
            x[0, i, j] = max(first[i, j], _SLOPE * first[i, j])
    for b in range(V1.shape[0]):
        np.dot(x[b, :n], V1[b], h[b, :n])
        _add_bias(h[b], a1[b], n)
        _leaky(h[b].ravel(), n * H)
        np.dot(h[b, :n], V2[b], x[b + 1, :n])
        _add_bias(x[b + 1], a2[b], n)
        _add(x[b + 1].ravel(), x[b].ravel(), n * H)


@njit(parallel=True, cache=True)
def forward(
    residuals,  # [M, G] float32
    index,  # [M] int64: row of shared, ascending
    shared,  # [A, H + O] float32: the anchor's part of the first layer and of the skip, biases included
    R,  # [G, H + O]
    V1,  # [blocks, H, H]
    a1,  # [blocks, H]
    V2,  # [blocks, H, H]
    a2,  # [blocks, H]
    U,  # [H, O]
    out,  # [M, O], written
):
    M, H, O, blocks = len(residuals), U.shape[0], U.shape[1], len(V1)
    groups = (M + ROWS - 1) // ROWS
    # Several groups to a task: scratch memory is allocated once per task.
    tasks = min(groups, 8 * CHUNKS)
    for t in prange(tasks):
        first = np.empty((ROWS, H + O), np.float32)
        x = np.empty((blocks + 1, ROWS, H), np.float32)
        h = np.empty((blocks, ROWS, H), np.float32)
        for g in range(groups * t // tasks, groups * (t + 1) // tasks):
            p, q = g * ROWS, min(M, (g + 1) * ROWS)
            n = q - p
            activations(residuals[p:q], index[p:q], shared, R, V1, a1, V2, a2, first[:n], x, h)
            np.dot(x[blocks, :n], U, out[p:q])
            for i in range(n):
                for j in range(O):
                    out[p + i, j] += first[i, H + j]


@njit(cache=True)
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


@njit(parallel=True, cache=True)
def backward(
    residuals,
    index,
    shared,
    R,
    V1,
    a1,
    V2,
    a2,
    U,
    d_out,  # [M, O]
    bounds,  # [chunks + 1] from chunk_bounds
    d_residuals,  # [M, G] written; [0, G] if not wanted
    d_shared,  # [A, H + O] zero, written; [0, H + O] if not wanted
    d_weights,  # [chunks, size] zero, written: R, per block V1, a1, V2, a2, then U; [chunks, 0] if not wanted
):
    G, H, O, blocks = len(R), U.shape[0], U.shape[1], len(V1)
    F = H + O
    want_residuals, want_shared, want_weights = (
        len(d_residuals) > 0,
        len(d_shared) > 0,
        d_weights.shape[1] > 0,
    )
    # BLAS takes a transposed right factor at half the rate.
    R_t, U_t = np.ascontiguousarray(R.T), np.ascontiguousarray(U.T)
    V1_t, V2_t = np.empty_like(V1), np.empty_like(V2)
    for b in range(blocks):
        V1_t[b], V2_t[b] = V1[b].T, V2[b].T
    for c in prange(len(bounds) - 1):
        first = np.empty((ROWS, F), np.float32)
        x = np.empty((blocks + 1, ROWS, H), np.float32)
        h = np.empty((blocks, ROWS, H), np.float32)
        dx = np.empty((ROWS, H), np.float32)
        dh = np.empty((ROWS, H), np.float32)
        part = np.empty((ROWS, H), np.float32)
        product_R = np.empty((G, F), np.float32)
        product_V = np.empty((H, H), np.float32)
        product_U = np.empty((H, O), np.float32)
        weights = d_weights[c]
        for p in range(bounds[c], bounds[c + 1], ROWS):
            q = min(bounds[c + 1], p + ROWS)
            n = q - p
            activations(residuals[p:q], index[p:q], shared, R, V1, a1, V2, a2, first[:n], x, h)
            d = d_out[p:q]
            np.dot(d, U_t, dx[:n])
            at = G * F + blocks * 2 * (H * H + H)
            if want_weights:
                np.dot(x[blocks, :n].T, d, product_U)
                _add(weights[at:], product_U.ravel(), H * O)
            for b in range(blocks - 1, -1, -1):
                at -= 2 * (H * H + H)
                np.dot(dx[:n], V2_t[b], dh[:n])
                _leaky_gradient(dh.ravel(), h[b].ravel(), n * H)
                if want_weights:
                    np.dot(x[b, :n].T, dh[:n], product_V)
                    _add(weights[at:], product_V.ravel(), H * H)
                    _add_rows(weights[at + H * H : at + H * H + H], dh, n)
                    np.dot(h[b, :n].T, dx[:n], product_V)
                    _add(weights[at + H * H + H :], product_V.ravel(), H * H)
                    _add_rows(weights[at + 2 * H * H + H : at + 2 * H * H + 2 * H], dx, n)
                np.dot(dh[:n], V1_t[b], part[:n])
                _add(dx.ravel(), part.ravel(), n * H)
            _leaky_gradient(dx.ravel(), x[0].ravel(), n * H)
            # `first` has served: it becomes its own gradient.
            for i in range(n):
                for j in range(H):
                    first[i, j] = dx[i, j]
                for j in range(O):
                    first[i, H + j] = d[i, j]
            if want_weights:
                np.dot(residuals[p:q].T, first[:n], product_R)
                _add(weights, product_R.ravel(), G * F)
            if want_residuals:
                np.dot(first[:n], R_t, d_residuals[p:q])
            if want_shared:
                for i in range(n):
                    anchor = index[p + i]
                    for j in range(F):
                        d_shared[anchor, j] += first[i, j]
