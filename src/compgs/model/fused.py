"""Paired prediction networks and all around them on the CPU: from anchors and residuals to the Gaussians of a view.

    all P primitives ──► appearance ──► opacity ──► the M that are drawn ──► geometry ──► means, scales, quaternions
                                                            └──► colors

The same as the plain torch of `prediction.py`, which the tests compare it with. Written out in torch the few operations
around the networks cost as much as the networks: a dozen passes over all primitives, copies of what is drawn, and
gradients of gathers that are summed by one thread. What is not drawn has no gradient, so the backward pass looks at the
drawn ones alone. Indices ascend, so that each anchor's gradient is summed by one thread, in order: the result does not
depend on the number of threads.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from compgs.model import residual_mlp
from compgs.model.appearance import sigmoid
from compgs.model.layers import ALL_ROWS, mlp_gradients, weight_arrays
from compgs.model.residual_mlp import CHUNKS, ROWS, chunk_bounds

_FASTMATH = {"contract", "nsz", "arcp"}
_ONE = np.float32(1)


class PairedPrediction(torch.autograd.Function):
    """The Gaussians that are drawn: means, scales [M, 3], quaternions [M, 4], opacities [M], colors [M, 3]; their index
    [M] (no gradient); and opacities [P] of all.
    """

    @staticmethod
    def forward(
        ctx: Any,
        seen: Tensor,  # [A, H + 4] the anchors' part of the appearance network (`ResidualMLP.begin`)
        shared: Tensor,  # [A, H + 10] and of the geometry network
        residuals: Tensor,  # [P, G]
        log_scales: Tensor,  # [A, 6]
        positions: Tensor,  # [A, 3] world units; without gradient
        anchor_index: Tensor,  # [P] int64, ascending
        voxel_size: float,  # world units
        cutoff: float,  # opacity that a primitive must exceed to be drawn
        *weights: Tensor,  # of the appearance network, then as many of the geometry network
    ) -> tuple[Tensor, ...]:
        seen, shared, residuals = seen.contiguous(), shared.contiguous(), residuals.contiguous()
        appearance, geometry = _halves(weights)
        raw = residuals.new_empty(len(residuals), 4)
        own, index = residuals.detach().numpy(), anchor_index.contiguous().numpy()
        residual_mlp.forward(
            own, ALL_ROWS, index, seen.detach().numpy(), *weight_arrays(appearance), raw.numpy()
        )
        all_opacities = torch.tanh(raw[:, 0])
        drawn = torch.nonzero(all_opacities > cutoff).view(-1)
        anchor = anchor_index.index_select(0, drawn)
        m = len(drawn)
        raw_geometry = raw.new_empty(m, 10)
        residual_mlp.forward(
            own,
            _rows(drawn, residuals),
            anchor.numpy(),
            shared.detach().numpy(),
            *weight_arrays(geometry),
            raw_geometry.numpy(),
        )
        reach = log_scales.detach().exp() * voxel_size
        means, scales, quaternions = raw.new_empty(m, 3), raw.new_empty(m, 3), raw.new_empty(m, 4)
        opacities, colors, moves = raw.new_empty(m), raw.new_empty(m, 3), raw.new_empty(m, 3)
        _finish(
            raw.numpy(),
            all_opacities.numpy(),
            drawn.numpy(),
            raw_geometry.numpy(),
            positions.detach().contiguous().numpy(),
            reach.numpy(),
            anchor.numpy(),
            means.numpy(),
            scales.numpy(),
            quaternions.numpy(),
            opacities.numpy(),
            colors.numpy(),
            moves.numpy(),
        )
        ctx.save_for_backward(
            seen, shared, residuals, anchor_index, drawn, anchor, all_opacities, opacities, colors,
            moves, reach, scales, *weights,
        )  # fmt: skip
        ctx.mark_non_differentiable(drawn)
        ctx.set_materialize_grads(False)
        return means, scales, quaternions, opacities, colors, drawn, all_opacities

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        (
            seen, shared, residuals, anchor_index, drawn, anchor, all_opacities, opacities, colors,
            moves, reach, scales, *weights,
        ) = ctx.saved_tensors  # fmt: skip
        appearance, geometry = _halves(weights)
        m = len(drawn)
        shapes = (m, 3), (m, 3), (m, 4), (m,), (m, 3)
        d_means, d_scales, d_quaternions, d_opacities, d_colors = (
            np.zeros(shape, np.float32) if g is None else g.contiguous().numpy()
            for g, shape in zip(grads, shapes, strict=False)
        )
        d_appearance, d_geometry = np.empty((m, 4), np.float32), np.empty((m, 10), np.float32)
        d_log_scales = torch.zeros_like(reach)
        _finish_gradient(
            opacities.detach().numpy(),
            colors.detach().numpy(),
            moves.numpy(),
            scales.detach().numpy(),
            reach.numpy(),
            anchor.numpy(),
            d_means,
            d_scales,
            d_quaternions,
            d_opacities,
            d_colors,
            chunk_bounds(anchor.numpy(), CHUNKS),
            d_appearance,
            d_geometry,
            d_log_scales.numpy(),
        )
        want_seen, want_shared, want_residuals, *_ = ctx.needs_input_grad
        want_weights = ctx.needs_input_grad[8:]
        d_residuals = residuals.new_zeros(len(residuals) if want_residuals else 0, residuals.shape[1])
        own, rows = residuals.detach().numpy(), _rows(drawn, residuals)
        d_shared, d_of_geometry = mlp_gradients(
            (own, rows, anchor.numpy(), shared.detach().numpy()),
            geometry,
            d_geometry,
            d_residuals.numpy(),
            want_shared=want_shared,
            want_weights=any(want_weights[len(appearance) :]),
        )
        index = anchor.numpy()
        if grads[6] is not None:  # what is not drawn is pulled at as well
            d_all = np.zeros((len(residuals), 4), np.float32)
            d_all[drawn.numpy()] = d_appearance
            d_all[:, 0] += (grads[6] * (1.0 - all_opacities.detach() ** 2)).numpy()
            rows, index, d_appearance = ALL_ROWS, anchor_index.contiguous().numpy(), d_all
        d_seen, d_of_appearance = mlp_gradients(
            (own, rows, index, seen.detach().numpy()),
            appearance,
            d_appearance,
            d_residuals.numpy(),
            want_shared=want_seen,
            want_weights=any(want_weights[: len(appearance)]),
        )
        by_residuals = d_residuals if want_residuals else None
        return (
            d_seen, d_shared, by_residuals, d_log_scales, None, None, None, None,
            *d_of_appearance, *d_of_geometry,
        )  # fmt: skip


def _halves(weights: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """The weights of the appearance and of the geometry network."""
    return weights[: len(weights) // 2], weights[len(weights) // 2 :]


def _rows(drawn: Tensor, residuals: Tensor) -> np.ndarray:
    """`rows` of `residual_mlp`: where all are drawn nothing need be gathered."""
    return ALL_ROWS if len(drawn) == len(residuals) else drawn.numpy()


@njit(parallel=True, fastmath=_FASTMATH, cache=True)
def _finish(
    raw, all_opacities, drawn, raw_geometry, positions, reach, anchor,
    means, scales, quaternions, opacities, colors, moves,
):  # fmt: skip
    m = len(drawn)
    for block in prange((m + ROWS - 1) // ROWS):
        first, last = block * ROWS, min(m, (block + 1) * ROWS)
        # Side by side, so that sigmoids are computed in vector registers.
        bounded = np.zeros((ROWS, 6), np.float32)
        for j in range(first, last):
            for c in range(3):
                bounded[j - first, c] = raw[drawn[j], 1 + c]
                bounded[j - first, 3 + c] = raw_geometry[j, 3 + c]
        flat = bounded.ravel()
        for i in range(6 * ROWS):
            flat[i] = sigmoid(flat[i])
        for j in range(first, last):
            a = anchor[j]
            opacities[j] = all_opacities[drawn[j]]
            for c in range(3):
                colors[j, c] = bounded[j - first, c]
                moves[j, c] = raw_geometry[j, c]
                means[j, c] = positions[a, c] + raw_geometry[j, c] * reach[a, c]
                scales[j, c] = reach[a, 3 + c] * bounded[j - first, 3 + c]
            quaternions[j, 0] = raw_geometry[j, 6] + _ONE
            for c in range(1, 4):
                quaternions[j, c] = raw_geometry[j, 6 + c]


@njit(parallel=True, fastmath=_FASTMATH, cache=True)
def _finish_gradient(
    opacities, colors, moves, scales, reach, anchor,
    d_means, d_scales, d_quaternions, d_opacities, d_colors,
    bounds, d_appearance, d_geometry, d_log_scales,
):  # fmt: skip
    for chunk in prange(len(bounds) - 1):
        for j in range(bounds[chunk], bounds[chunk + 1]):
            a = anchor[j]
            d_appearance[j, 0] = d_opacities[j] * (_ONE - opacities[j] * opacities[j])
            for c in range(3):
                d_appearance[j, 1 + c] = d_colors[j, c] * colors[j, c] * (_ONE - colors[j, c])
                moved = d_means[j, c] * reach[a, c]
                d_geometry[j, c] = moved
                d_log_scales[a, c] += moved * moves[j, c]
                grown = d_scales[j, c] * scales[j, c]
                d_geometry[j, 3 + c] = grown * (_ONE - scales[j, c] / reach[a, 3 + c])
                d_log_scales[a, 3 + c] += grown
            for c in range(4):
                d_geometry[j, 6 + c] = d_quaternions[j, c]
