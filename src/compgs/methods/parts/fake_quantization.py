"""Values as a file will hold them, in a training that goes on: rounded ahead, with gradients as if they were not."""

from typing import Any

import torch
from torch import Tensor


def straight_through(values: Tensor, drawn: Tensor) -> Tensor:
    """`drawn`, exactly; its gradient goes to `values` (of the same shape), as if it were these."""
    result: Tensor = _StraightThrough.apply(values, drawn)
    return result


def fake_levels(values: Tensor, bits: int = 8) -> Tensor:
    """The values as 2^bits levels from their smallest to their largest show them: what `levels.Levels` gives, to the
    last digit."""
    with torch.no_grad():
        low = values.min()
        step = (values.max() - low) / float((1 << bits) - 1)
        step = torch.where(step > 0, step, torch.ones_like(step))
        drawn = low + torch.round((values - low) / step) * step
    return straight_through(values, drawn)


def fake_half(values: Tensor) -> Tensor:
    """The values in half precision; larger ones than that can hold are its largest."""
    most = torch.finfo(torch.float16).max
    with torch.no_grad():
        drawn = values.clamp(-most, most).half().to(values.dtype)
    return straight_through(values, drawn)


class _StraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, drawn: Tensor) -> Tensor:
        assert values.shape == drawn.shape, (values.shape, drawn.shape)
        return drawn.detach().clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None
