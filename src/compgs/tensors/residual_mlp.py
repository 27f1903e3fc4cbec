"""The residual MLP of the prediction networks (CompGS Sec. 3.2).

    [f, g] ─► linear ─► leaky ReLU ─► blocks x (x + linear ─ leaky ReLU ─ linear) ─► linear ─► + ─► out
       └──────────────────────────────── linear (skip) ────────────────────────────────────────┘

`f` are the features of an anchor, `g` the residual embedding of one of its coupled primitives. What the first
layer and the skip make of `f` is computed once per anchor. All weights are [in, out]; rows of `f` come before
those of `g`. This is the readable version. On the CPU in float32 its twins do the work: `residual_mlp_kernels.py` in
training, `model/network_kernels.py` in rendering.
"""

import math

import torch
from torch import Tensor, nn

from compgs.model.constants import NEGATIVE_SLOPE
from compgs.tensors import where
from compgs.tensors.autograd import KernelMLP
from compgs.tensors.linear import linear


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
        if where.in_kernels(shared, residuals):
            return KernelMLP.apply(shared, residuals, anchor_index, *weights)
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

    def _entry(self) -> tuple[Tensor, Tensor, Tensor]:
        """First layer and skip side by side: of the anchor, of the residual [inputs, width + outputs]; bias."""
        entry = torch.cat([self.input_weight, self.skip_weight], 1)
        bias = torch.cat([self.input_bias, self.output_bias])
        return entry[: self.anchor_dim], entry[self.anchor_dim :], bias

    def _after_entry(self, entry: Tensor) -> list[Tensor]:
        return [entry, *(p for block in self.blocks for p in block.parameters()), self.output_weight]
