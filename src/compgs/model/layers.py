"""The residual MLP of the prediction networks (CompGS Sec. 3.2).

    [f, g] ─► linear ─► leaky ReLU ─► blocks x (x + linear ─ leaky ReLU ─ linear) ─► linear ─► + ─► out
       └──────────────────────────────── linear (skip) ────────────────────────────────────────┘

`f` are the features of an anchor, `g` the residual embedding of one of its coupled primitives. What the first
layer and the skip make of `f` is computed once per anchor. All weights are [in, out]; rows of `f` come before
those of `g`.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from compgs.model import residual_mlp
from compgs.model.residual_mlp import NEGATIVE_SLOPE
from compgs.numerics.linear import linear


def _linear(inputs: int, outputs: int) -> tuple[nn.Parameter, nn.Parameter]:
    """Weight [inputs, outputs] and bias [outputs], uniform in +-1/sqrt(inputs)."""
    bound = 1.0 / math.sqrt(inputs)
    weight = nn.Parameter(torch.empty(inputs, outputs).uniform_(-bound, bound))
    return weight, nn.Parameter(torch.empty(outputs).uniform_(-bound, bound))


class ResidualBlock(nn.Module):
    """x + linear(leaky(linear(x))), `width` channels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight1, self.bias1 = _linear(width, width)
        self.weight2, self.bias2 = _linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        hidden = nn.functional.leaky_relu(torch.addmm(self.bias1, x, self.weight1), NEGATIVE_SLOPE)
        return x + torch.addmm(self.bias2, hidden, self.weight2)


class ResidualMLP(nn.Module):
    """Anchor features and residual embeddings in, one row of outputs per coupled primitive out.

    The bias of the last layer is `output_bias`; the skip has none of its own.
    """

    def __init__(
        self, anchor_dim: int, residual_dim: int, outputs: int, width: int = 32, blocks: int = 1
    ) -> None:
        super().__init__()
        self.anchor_dim = anchor_dim
        self.width = width
        self.input_weight, self.input_bias = _linear(anchor_dim + residual_dim, width)
        self.blocks = nn.ModuleList(ResidualBlock(width) for _ in range(blocks))
        self.output_weight, self.output_bias = _linear(width, outputs)
        self.skip_weight, _ = _linear(anchor_dim + residual_dim, outputs)

    def forward(
        self,
        anchor_features: Tensor,  # [A, anchor_dim]
        residuals: Tensor,  # [M, residual_dim]
        anchor_index: Tensor,  # [M] int64, ascending: row of anchor_features of each coupled primitive
    ) -> Tensor:  # [M, outputs]
        shared, weights = self.begin(anchor_features)
        entry = weights[0]
        if shared.device.type == "cpu" and shared.dtype == residuals.dtype == torch.float32:
            return _FusedMLP.apply(shared, residuals, anchor_index, *weights)
        first = torch.addmm(shared.index_select(0, anchor_index), residuals, entry)  # float16 under autocast
        x = nn.functional.leaky_relu(first[:, : self.width], NEGATIVE_SLOPE)
        for block in self.blocks:
            x = block(x)
        return torch.addmm(first[:, self.width :], x, self.output_weight)

    def begin(self, anchor_features: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The anchors' part of the first layer and of the skip, biases included [A, width + outputs]; other weights: of
        the residual [residual_dim, width + outputs], four of each block, of the output.
        """
        anchor_entry, entry, bias = self._entry()
        return linear(anchor_features, anchor_entry, bias), self._after_entry(entry)

    def arrays(self) -> "MLPArrays":
        """A, bias [H + O] of the anchor's part, then R, V1, a1, V2, a2, U of `residual_mlp`: copies, in float32."""
        anchor_entry, entry, bias = (t.detach() for t in self._entry())
        return anchor_entry.numpy(), bias.numpy(), *weight_arrays(self._after_entry(entry))

    def _entry(self) -> tuple[Tensor, Tensor, Tensor]:
        """First layer and skip side by side: of the anchor, of the residual [inputs, width + outputs]; bias."""
        entry = torch.cat([self.input_weight, self.skip_weight], 1)
        bias = torch.cat([self.input_bias, self.output_bias])
        return entry[: self.anchor_dim], entry[self.anchor_dim :], bias

    def _after_entry(self, entry: Tensor) -> list[Tensor]:
        return [entry, *(p for block in self.blocks for p in block.parameters()), self.output_weight]


_A = np.ndarray
MLPArrays = tuple[_A, _A, _A, _A, _A, _A, _A, _A]
ALL_ROWS = np.empty(0, np.int64)


def weight_arrays(weights: Sequence[Tensor]) -> tuple[_A, _A, _A, _A, _A, _A]:
    """R, V1, a1, V2, a2, U of `residual_mlp` from the weights of `ResidualMLP.begin`."""
    values = [w.detach().contiguous().numpy() for w in weights]
    width = len(values[-1])
    blocks = (len(values) - 2) // 4
    shapes = (width, width), (width,), (width, width), (width,)
    stacked = [
        np.stack(values[1 + k : -1 : 4]) if blocks else np.zeros((0, *shape), np.float32)
        for k, shape in enumerate(shapes)
    ]
    V1, a1, V2, a2 = stacked
    return values[0], V1, a1, V2, a2, values[-1]


def mlp_gradients(
    inputs: tuple[_A, _A, _A, _A],  # residuals, rows, index, shared of `residual_mlp.forward`
    weights: Sequence[Tensor],  # of `ResidualMLP.begin`
    d_out: _A,  # [M, outputs]
    d_residuals: _A,  # added to; [0, residual_dim]: not wanted
    *,
    want_shared: bool,
    want_weights: bool,
) -> tuple[Tensor | None, list[Tensor | None]]:
    """Gradients by the anchors' part and by the weights, where wanted."""
    index, shared = inputs[2], inputs[3]
    d_shared = np.zeros((len(shared) if want_shared else 0, shared.shape[1]), np.float32)
    sizes = [w.numel() for w in weights]
    parts = np.zeros((residual_mlp.CHUNKS, sum(sizes) if want_weights else 0), np.float32)
    bounds = residual_mlp.chunk_bounds(index, residual_mlp.CHUNKS)
    residual_mlp.backward(*inputs, *weight_arrays(weights), d_out, bounds, d_residuals, d_shared, parts)
    d_weights: list[Tensor | None] = [None] * len(weights)
    if want_weights:
        pieces = torch.from_numpy(parts.sum(0)).split(sizes)
        d_weights = [g.view(w.shape) for g, w in zip(pieces, weights, strict=True)]
    return torch.from_numpy(d_shared) if want_shared else None, d_weights


class _FusedMLP(torch.autograd.Function):
    """Everything after the anchor's part, on the CPU in float32; see `ResidualMLP.begin`."""

    @staticmethod
    def forward(ctx: Any, shared: Tensor, residuals: Tensor, index: Tensor, *weights: Tensor) -> Tensor:
        shared, residuals, index = shared.contiguous(), residuals.contiguous(), index.contiguous()
        out = residuals.new_empty(len(residuals), weights[-1].shape[1])
        inputs = residuals.detach().numpy(), ALL_ROWS, index.numpy(), shared.detach().numpy()
        residual_mlp.forward(*inputs, *weight_arrays(weights), out.numpy())
        ctx.save_for_backward(shared, residuals, index, *weights)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        shared, residuals, index, *weights = ctx.saved_tensors
        want_shared, want_residuals, _, *want_weights = ctx.needs_input_grad
        d_residuals = residuals.new_zeros(len(residuals) if want_residuals else 0, residuals.shape[1])
        d_shared, d_weights = mlp_gradients(
            (residuals.detach().numpy(), ALL_ROWS, index.numpy(), shared.detach().numpy()),
            weights,
            grads[0].contiguous().numpy(),
            d_residuals.numpy(),
            want_shared=want_shared,
            want_weights=any(want_weights),
        )
        return d_shared, d_residuals if want_residuals else None, None, *d_weights
