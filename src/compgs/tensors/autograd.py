"""The kernels as functions with gradients: what joins them to torch in training, on the CPU in float32.

    all P primitives ──► appearance ──► opacity ──► the M that are drawn ──► geometry ──► means, scales, quaternions
                                                            └──► colors

The same as the plain torch of `residual_mlp.py` and `prediction.py`, which the tests compare it with. Written out in
torch the few operations around the networks cost as much as the networks: a dozen passes over all primitives, copies of
what is drawn, and gradients of gathers that are summed by one thread. What is not drawn has no gradient, so the
backward pass looks at the drawn ones alone. Indices ascend, so that each anchor's gradient is summed by one thread, in
order: the result does not depend on the number of threads.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.model import network_kernels, prediction_kernels
from compgs.model.arrays import ALL_ROWS, AfterEntry
from compgs.model.constants import OPACITY_CUTOFF
from compgs.tensors import residual_mlp_kernels
from compgs.tensors.residual_mlp_kernels import CHUNKS, chunk_bounds, rows_with_gradient

_Array = np.ndarray


class KernelMLP(torch.autograd.Function):
    """`ResidualMLP` after the anchors' part: see `ResidualMLP.begin` for the weights."""

    @staticmethod
    def forward(ctx: Any, shared: Tensor, residuals: Tensor, index: Tensor, *weights: Tensor) -> Tensor:
        shared, residuals, index = shared.contiguous(), residuals.contiguous(), index.contiguous()
        out = residuals.new_empty(len(residuals), weights[-1].shape[1])
        inputs = residuals.detach().numpy(), ALL_ROWS, index.numpy(), shared.detach().numpy()
        network_kernels.forward(*inputs, *_stacked(weights), out.numpy())
        ctx.save_for_backward(shared, residuals, index, *weights)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        shared, residuals, index, *weights = ctx.saved_tensors
        want_shared, want_residuals, _, *want_weights = ctx.needs_input_grad
        d_residuals = residuals.new_zeros(len(residuals) if want_residuals else 0, residuals.shape[1])
        d_shared, d_weights = _mlp_gradients(
            (residuals.detach().numpy(), ALL_ROWS, index.numpy(), shared.detach().numpy()),
            weights,
            grads[0].contiguous().numpy(),
            d_residuals.numpy(),
            want_shared=want_shared,
            want_weights=any(want_weights),
        )
        return d_shared, d_residuals if want_residuals else None, None, *d_weights


class PairedPrediction(torch.autograd.Function):
    """The Gaussians that are drawn, by paired networks: means, scales [M, 3], quaternions [M, 4], opacities [M], colors
    [M, 3]; their index [M] (no gradient); and opacities [P] of all.
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
        *weights: Tensor,  # of the appearance network, then as many of the geometry network
    ) -> tuple[Tensor, ...]:
        seen, shared, residuals = seen.contiguous(), shared.contiguous(), residuals.contiguous()
        anchor_index = anchor_index.contiguous()
        appearance, geometry = _halves(weights)
        own = residuals.detach().numpy()
        raw = residuals.new_empty(len(residuals), 4)
        inputs = own, ALL_ROWS, anchor_index.numpy(), seen.detach().numpy()
        network_kernels.forward(*inputs, *_stacked(appearance), raw.numpy())
        all_opacities = torch.tanh(raw[:, 0])
        drawn = torch.nonzero(all_opacities > OPACITY_CUTOFF).view(-1)
        opacities, colors = all_opacities.index_select(0, drawn), raw.new_empty(len(drawn), 3)
        prediction_kernels.activate_colors(raw.numpy(), drawn.numpy(), colors.numpy())

        anchor = anchor_index.index_select(0, drawn)
        raw_geometry = raw.new_empty(len(drawn), 10)
        inputs = own, _rows(drawn, residuals), anchor.numpy(), shared.detach().numpy()
        network_kernels.forward(*inputs, *_stacked(geometry), raw_geometry.numpy())
        spread = log_scales.detach().exp() * voxel_size
        means, scales, quaternions = (raw.new_empty(len(drawn), size) for size in (3, 3, 4))
        prediction_kernels.affine_transform(
            raw_geometry.numpy(),
            anchor.numpy(),
            positions.detach().contiguous().numpy(),
            spread.numpy(),
            means.numpy(),
            scales.numpy(),
            quaternions.numpy(),
        )
        translations = raw_geometry[:, :3].contiguous()
        ctx.save_for_backward(
            seen, shared, residuals, anchor_index, drawn, anchor, all_opacities, opacities, colors,
            translations, spread, scales, *weights,
        )  # fmt: skip
        ctx.mark_non_differentiable(drawn)
        ctx.set_materialize_grads(False)
        return means, scales, quaternions, opacities, colors, drawn, all_opacities

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        (
            seen, shared, residuals, anchor_index, drawn, anchor, all_opacities, opacities, colors,
            translations, spread, scales, *weights,
        ) = ctx.saved_tensors  # fmt: skip
        appearance, geometry = _halves(weights)
        m = len(drawn)
        shapes = (m, 3), (m, 3), (m, 4), (m,), (m, 3)
        d_means, d_scales, d_quaternions, d_opacities, d_colors = (
            np.zeros(shape, np.float32) if g is None else g.contiguous().numpy()
            for g, shape in zip(grads, shapes, strict=False)
        )
        d_appearance, d_geometry = np.empty((m, 4), np.float32), np.empty((m, 10), np.float32)
        d_log_scales = torch.zeros_like(spread)
        prediction_kernels.activation_gradients(
            opacities.detach().numpy(),
            colors.detach().numpy(),
            translations.numpy(),
            scales.detach().numpy(),
            spread.numpy(),
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
        want_weights = ctx.needs_input_grad[-len(weights) :]
        d_residuals = residuals.new_zeros(len(residuals) if want_residuals else 0, residuals.shape[1])
        own, rows = residuals.detach().numpy(), _rows(drawn, residuals)
        d_shared, d_of_geometry = _mlp_gradients(
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
            rows, index, d_appearance = ALL_ROWS, anchor_index.numpy(), d_all
        d_seen, d_of_appearance = _mlp_gradients(
            (own, rows, index, seen.detach().numpy()),
            appearance,
            d_appearance,
            d_residuals.numpy(),
            want_shared=want_seen,
            want_weights=any(want_weights[: len(appearance)]),
        )
        by_residuals = d_residuals if want_residuals else None
        return (
            d_seen, d_shared, by_residuals, d_log_scales, None, None, None, *d_of_appearance, *d_of_geometry,
        )  # fmt: skip


def _halves(weights: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """The weights of the appearance and of the geometry network."""
    return weights[: len(weights) // 2], weights[len(weights) // 2 :]


def _rows(drawn: Tensor, residuals: Tensor) -> _Array:
    """`rows` of the kernels: where all are drawn nothing need be gathered."""
    return ALL_ROWS if len(drawn) == len(residuals) else drawn.numpy()


def _stacked(weights: Sequence[Tensor]) -> AfterEntry:
    """The weights of `ResidualMLP.begin` as the kernels take them: see `MLPArrays.after_entry`."""
    values = [w.detach().contiguous().numpy() for w in weights]
    width = len(values[-1])
    blocks = (len(values) - 2) // 4
    shapes = (width, width), (width,), (width, width), (width,)
    weights1, biases1, weights2, biases2 = (
        np.stack(values[1 + k : -1 : 4]) if blocks else np.zeros((0, *shape), np.float32)
        for k, shape in enumerate(shapes)
    )
    return values[0], weights1, biases1, weights2, biases2, values[-1]


def _mlp_gradients(
    inputs: tuple[_Array, _Array, _Array, _Array],  # residuals, rows, index, shared of the kernel `forward`
    weights: Sequence[Tensor],  # of `ResidualMLP.begin`
    d_out: _Array,  # [M, outputs]
    d_residuals: _Array,  # added to; [0, residual_dim]: not wanted
    *,
    want_shared: bool,
    want_weights: bool,
) -> tuple[Tensor | None, list[Tensor | None]]:
    """Gradients by the anchors' part and by the weights, where wanted."""
    own, rows, index, shared = inputs
    found = rows_with_gradient(d_out)
    if len(found) < len(d_out):
        rows, index, d_out = found if rows is ALL_ROWS else rows[found], index[found], d_out[found]
    d_shared = np.zeros((len(shared) if want_shared else 0, shared.shape[1]), np.float32)
    sizes = [w.numel() for w in weights]
    parts = np.zeros((CHUNKS, sum(sizes) if want_weights else 0), np.float32)
    bounds = chunk_bounds(index, CHUNKS)
    if len(d_out) > 0:  # no rows would mean all of them
        inputs = own, rows, index, shared
        residual_mlp_kernels.backward(
            *inputs, *_stacked(weights), d_out, bounds, d_residuals, d_shared, parts
        )
    d_weights: list[Tensor | None] = [None] * len(weights)
    if want_weights:
        pieces = torch.from_numpy(parts.sum(0)).split(sizes)
        d_weights = [g.view(w.shape) for g, w in zip(pieces, weights, strict=True)]
    return torch.from_numpy(d_shared) if want_shared else None, d_weights
