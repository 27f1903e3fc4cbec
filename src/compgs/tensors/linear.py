"""x W + b, with gradients that do not depend on the number of threads.

A weight's gradient is a sum over all rows. BLAS divides such a product among its threads along that sum, so that one
and two threads round differently, and the same seed gives another file on another machine. Here rows are summed in
PARTS parts, which are then added in order.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.numerics.compiled import chunk_of, njit
from compgs.numerics.products import add_product
from compgs.tensors import where

PARTS = 16


@dataclass(frozen=True)
class ReferenceLayer:
    """A linear layer with the reference embedding among its inputs."""

    weight: Tensor
    bias: Tensor  # what the layer adds to the products
    dimension: int  # of the weight: its inputs
    first: int  # input that is the references' first channel
    unit: float  # what the layer takes a quantization step of them for


def linear(
    x: Tensor,  # [N, inputs]
    weight: Tensor,  # [inputs, outputs]
    bias: Tensor,  # [outputs]
) -> Tensor:  # [N, outputs]
    if where.in_kernels(x, weight) and not torch.is_autocast_enabled("cpu"):
        return _Linear.apply(x, weight, bias)
    return torch.addmm(bias, x, weight)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return torch.addmm(bias, x, weight)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (x, weight), g = ctx.saved_tensors, grads[0]
        want_x, want_weight, want_bias = ctx.needs_input_grad
        return (
            g @ weight.t() if want_x else None,
            transposed_product(x, g) if want_weight else None,
            g.sum(0) if want_bias else None,
        )


def transposed_product(x: Tensor, y: Tensor) -> Tensor:
    """x^T y [A, B] of x [N, A] and y [N, B], float32 on the CPU; the same bits with any number of threads."""
    parts = np.zeros((PARTS, x.shape[1], y.shape[1]), np.float32)
    _sum_products(x.detach().contiguous().numpy(), y.detach().contiguous().numpy(), parts)
    return torch.from_numpy(parts.sum(0))


@njit(parallel=True)
def _sum_products(x, y, parts, part):
    n = len(x)
    for c in chunk_of(len(parts), part):
        first, last = n * c // len(parts), n * (c + 1) // len(parts)
        add_product(x[first:last].T, y[first:last], parts[c])
