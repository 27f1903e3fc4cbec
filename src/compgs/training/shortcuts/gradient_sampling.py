"""Gradients of a view that are led through the prediction networks: all large ones, and of the small ones a sample.

Of what is drawn of a view, most hardly shows: half of the primitives have a hundredth of all gradients, and cost the
backward pass of the networks as much as the others. Of these some are taken by chance, each with a probability that
goes with its gradient, which becomes as much larger: the expectation is the same, the variance hardly grows
(docs/results/tried.md), and whatever has no gradient is passed over by the kernels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.numerics.compiled import njit
from compgs.tensors import where


@dataclass
class GradientSizes:
    """How large the gradients of M primitives are, before they are sampled; known after the backward pass."""

    values: Tensor | None = None  # [M] float32, in means over all of them; None: not known


def with_sampled_gradients(
    gaussians: Gaussians[Tensor],
    share: float,
    noise: Callable[[Tensor], Tensor],
    sizes: GradientSizes | None = None,
) -> Gaussians[Tensor]:
    """The same Gaussians. Going backward, of gradients below `share` times the mean only a sample is left; 0: all of
    them are, as where they do not lead to kernels, which alone pass over what has none.

    `noise`: uniform in [-0.5, 0.5), of the shape of what it is given. A single number is all chance that there is: the
    sample is a systematic one, so that neighbours in the file stand in for one another. `sizes`: where those of the
    gradients will be, if they are sampled.
    """
    g = gaussians
    if share <= 0.0 or not where.runs_in_kernels(g.means.device, g.means.dtype):
        return gaussians
    start = float(noise(g.means.new_empty(1))) + 0.5
    return Gaussians(
        *_Sampled.apply(g.means, g.quaternions, g.scales, g.opacities, g.colors, share, start, sizes)
    )


class _Sampled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        share: float,
        start: float,
        sizes: GradientSizes | None,
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(scales)
        ctx.share, ctx.start, ctx.sizes = share, start, sizes or GradientSizes()
        parts = means, quaternions, scales, opacities, colors
        return tuple(part.view_as(part) for part in parts)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (scales,) = ctx.saved_tensors
        gradients = [gradient.contiguous().numpy() for gradient in grads]
        found = tuple(np.empty_like(gradient) for gradient in gradients)
        sizes = np.empty(len(scales), np.float32)
        _sample(tuple(gradients), scales.contiguous().numpy(), ctx.share, ctx.start, found, sizes)
        ctx.sizes.values = torch.from_numpy(sizes)
        return *(torch.from_numpy(part) for part in found), None, None, None


@njit(error_model="numpy")
def _sample(gradients, scales, share, start, found, sizes):
    """Keep all gradients of a primitive or none; sizes are compared in what no unit of length changes."""
    means, quaternions, spreads, opacities, colors = gradients
    count = len(opacities)
    shown, placed = np.empty(count, np.float32), np.empty(count, np.float32)
    all_shown = all_placed = 0.0
    for i in range(count):
        shown[i] = abs(opacities[i]) + abs(colors[i, 0]) + abs(colors[i, 1]) + abs(colors[i, 2])
        moved = 0.0
        for c in range(3):
            moved += (abs(means[i, c]) + abs(spreads[i, c])) * scales[i, c]
        placed[i] = moved
        all_shown += shown[i]
        all_placed += moved
    by_shown, by_placed = count / (2.0 * share * all_shown), count / (2.0 * share * all_placed)
    if not (np.isfinite(by_shown) and np.isfinite(by_placed)):
        by_shown, by_placed = np.inf, np.inf  # all of them: nothing is small beside nothing
    due = start
    for i in range(count):
        # NaN, as of a run that has diverged, is not less than 1
        chance = shown[i] * by_shown + placed[i] * by_placed
        sizes[i] = share * chance
        factor = np.float32(1.0)
        if chance < 1.0:
            due += chance
            factor = np.float32(0.0)
            if due >= 1.0:
                due -= 1.0
                factor = np.float32(1.0 / chance)
        for c in range(3):
            found[0][i, c] = factor * means[i, c]
            found[2][i, c] = factor * spreads[i, c]
            found[4][i, c] = factor * colors[i, c]
        for c in range(4):
            found[1][i, c] = factor * quaternions[i, c]
        found[3][i] = factor * opacities[i]
