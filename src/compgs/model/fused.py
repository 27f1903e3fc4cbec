"""What lies between the prediction networks and the Gaussians, on the CPU in one pass each way.

The same as the plain torch of `prediction.py`, which the tests compare it with. Written out in torch these few
operations cost as much as the networks: a dozen passes over all primitives, and gradients of gathers that are summed by
one thread. Indices ascend, so that each anchor's gradient is summed by one thread, in order: the result does not
depend on the number of threads.
"""

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from compgs.model.residual_mlp import CHUNKS, chunk_bounds

_FASTMATH = {"contract", "nsz", "arcp"}
_ONE = np.float32(1)


class SelectVisible(torch.autograd.Function):
    """raw [P, 4], residuals [P, G] -> of the primitives that are drawn: opacities [M], colors [M, 3], residuals [M, G];
    their index [M] (no gradient), and opacities [P] of all.
    """

    @staticmethod
    def forward(ctx: Any, raw: Tensor, residuals: Tensor, cutoff: float) -> tuple[Tensor, ...]:
        raw, residuals = raw.contiguous(), residuals.contiguous()
        all_opacities = torch.tanh(raw.detach()[:, 0])
        index = torch.nonzero(all_opacities > cutoff).view(-1)
        m = len(index)
        opacities, colors = raw.new_empty(m), raw.new_empty(m, 3)
        chosen = residuals.new_empty(m, residuals.shape[1])
        _select(
            raw.detach().numpy(),
            residuals.detach().numpy(),
            all_opacities.numpy(),
            index.numpy(),
            opacities.numpy(),
            colors.numpy(),
            chosen.numpy(),
        )
        ctx.save_for_backward(index, opacities, colors, all_opacities)
        ctx.shapes = raw.shape, residuals.shape
        ctx.mark_non_differentiable(index)
        ctx.set_materialize_grads(False)
        return opacities, colors, chosen, index, all_opacities

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        index, opacities, colors, all_opacities = ctx.saved_tensors
        d_raw, d_residuals = (opacities.new_zeros(shape) for shape in ctx.shapes)
        d_opacities, d_colors, d_chosen = (
            shape_of.new_zeros(shape_of.shape) if g is None else g.contiguous()
            for g, shape_of in zip(
                grads, (opacities, colors, opacities.new_empty(len(index), ctx.shapes[1][1])), strict=False
            )
        )
        _select_gradient(
            index.numpy(),
            opacities.detach().numpy(),
            colors.detach().numpy(),
            d_opacities.numpy(),
            d_colors.numpy(),
            d_chosen.numpy(),
            d_raw.numpy(),
            d_residuals.numpy(),
        )
        if grads[4] is not None:
            d_raw[:, 0] += grads[4] * (1.0 - all_opacities.detach() ** 2)
        return d_raw, d_residuals, None


class AffineTransform(torch.autograd.Function):
    """raw [M, 10], positions [A, 3], log_scales [A, 6], index [M] ascending -> means, scales [M, 3], quaternions."""

    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, positions: Tensor, log_scales: Tensor, index: Tensor, voxel_size: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        raw, index = raw.contiguous(), index.contiguous()
        reach = log_scales.detach().exp() * voxel_size
        m = len(raw)
        means, scales, quaternions = raw.new_empty(m, 3), raw.new_empty(m, 3), raw.new_empty(m, 4)
        _affine(
            raw.detach().numpy(),
            positions.detach().contiguous().numpy(),
            reach.numpy(),
            index.numpy(),
            means.numpy(),
            scales.numpy(),
            quaternions.numpy(),
        )
        ctx.save_for_backward(raw, reach, index, scales)
        return means, scales, quaternions

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        raw, reach, index, scales = ctx.saved_tensors
        d_raw, d_log_scales = torch.empty_like(raw), torch.zeros_like(reach)
        _affine_gradient(
            raw.detach().numpy(),
            reach.numpy(),
            index.numpy(),
            scales.detach().numpy(),
            grads[0].contiguous().numpy(),
            grads[1].contiguous().numpy(),
            grads[2].contiguous().numpy(),
            chunk_bounds(index.numpy(), CHUNKS),
            d_raw.numpy(),
            d_log_scales.numpy(),
        )
        return d_raw, None, d_log_scales, None, None


@njit(parallel=True, fastmath=_FASTMATH, cache=True)
def _select(raw, residuals, all_opacities, index, opacities, colors, chosen):
    for j in prange(len(index)):
        p = index[j]
        opacities[j] = all_opacities[p]
        for c in range(3):
            colors[j, c] = _ONE / (_ONE + np.exp(-raw[p, 1 + c]))
        for c in range(residuals.shape[1]):
            chosen[j, c] = residuals[p, c]


@njit(parallel=True, fastmath=_FASTMATH, cache=True)
def _select_gradient(index, opacities, colors, d_opacities, d_colors, d_chosen, d_raw, d_residuals):
    for j in prange(len(index)):
        p = index[j]
        d_raw[p, 0] = d_opacities[j] * (_ONE - opacities[j] * opacities[j])
        for c in range(3):
            d_raw[p, 1 + c] = d_colors[j, c] * colors[j, c] * (_ONE - colors[j, c])
        for c in range(d_residuals.shape[1]):
            d_residuals[p, c] = d_chosen[j, c]


@njit(parallel=True, fastmath=_FASTMATH, cache=True)
def _affine(raw, positions, reach, index, means, scales, quaternions):
    for j in prange(len(index)):
        a = index[j]
        for c in range(3):
            means[j, c] = positions[a, c] + raw[j, c] * reach[a, c]
            scales[j, c] = reach[a, 3 + c] / (_ONE + np.exp(-raw[j, 3 + c]))
        quaternions[j, 0] = raw[j, 6] + _ONE
        for c in range(1, 4):
            quaternions[j, c] = raw[j, 6 + c]


@njit(parallel=True, fastmath=_FASTMATH, cache=True)
def _affine_gradient(
    raw, reach, index, scales, d_means, d_scales, d_quaternions, bounds, d_raw, d_log_scales
):
    for chunk in prange(len(bounds) - 1):
        for j in range(bounds[chunk], bounds[chunk + 1]):
            a = index[j]
            for c in range(3):
                moved = d_means[j, c] * reach[a, c]
                d_raw[j, c] = moved
                d_log_scales[a, c] += moved * raw[j, c]
                grown = d_scales[j, c] * scales[j, c]
                d_raw[j, 3 + c] = grown * (_ONE - scales[j, c] / reach[a, 3 + c])
                d_log_scales[a, 3 + c] += grown
            for c in range(4):
                d_raw[j, 6 + c] = d_quaternions[j, c]
