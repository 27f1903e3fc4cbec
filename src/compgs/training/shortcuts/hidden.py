"""Anchors that a view does not show, though they are in its frustum: they stand behind others.

A third of the anchors in view hardly show, and cost as much as the others until their gradients turn out to be nothing.
Each view remembers which did not in its last two looks; its next steps pass them over. In every step with the rate
(`rare_rate`), which counts the bits of all anchors in view, all are looked at again: on average at every fourth visit
of a view, or every eighth (docs/results/tried.md). Before there is a rate, much is hidden now and seen soon: then all
are looked at.

One look is not enough: in a short run the scene is another before the next one. The view would be drawn without what
has come into sight, and its gradients would change parts that are right. In a run of Truck of 2 400 steps, each view in
twelve of them, that took 1.5 to 3 dB off the training views for a tenth of the run (docs/results/truck.md).

What counts are the gradients by an anchor's primitives. Something that shows always has some: L1 pulls at every value
by as much, however small the error is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.losses import FEW_DRAWN
from compgs.numerics.compiled import njit
from compgs.tensors import where
from compgs.tensors.prediction import Prediction
from compgs.training.run.restoring import check_tensor


@dataclass
class GradientSizes:
    """How large the gradients of M primitives are; known after the backward pass."""

    values: Tensor | None = None  # [M] float32, in means over all of them; None: not known


def with_gradient_sizes(gaussians: Gaussians[Tensor], sizes: GradientSizes) -> Gaussians[Tensor]:
    """The same Gaussians, whose backward pass fills `sizes` where it leads to kernels."""
    g = gaussians
    if not where.runs_in_kernels(g.means.device, g.means.dtype):
        return gaussians
    return Gaussians(*_Measured.apply(g.means, g.quaternions, g.scales, g.opacities, g.colors, sizes))


class _Measured(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        sizes: GradientSizes,
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(scales)
        ctx.sizes = sizes
        return tuple(part.view_as(part) for part in (means, quaternions, scales, opacities, colors))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (scales,) = ctx.saved_tensors
        means, _, spreads, opacities, colors = (gradient.contiguous().numpy() for gradient in grads)
        sizes = np.empty(len(scales), np.float32)
        _measure(means, spreads, opacities, colors, scales.contiguous().numpy(), sizes)
        ctx.sizes.values = torch.from_numpy(sizes)
        return *grads, None


class HiddenAnchors:
    """Remembers for each training view the anchors that hardly showed in its last two looks at them."""

    def __init__(self, share: float, views: int, shape: tuple[int, int], device: torch.device) -> None:
        """`share`: of the mean gradient, below which an anchor is hidden; 0: none is. `shape`: N, K."""
        self.share = share
        anchors, self.coupled_primitives = shape
        remembered = views if self.share > 0.0 else 0
        # [N, views / 8] a bit for each anchor and view, twice: of a million anchors and 300 views 76 MB
        self.missed = torch.zeros(anchors, -(-remembered // 8), dtype=torch.uint8, device=device)  # last time
        self.hidden = torch.zeros_like(self.missed)  # and the time before

    def others(self, view: int, rows: Tensor) -> Tensor:
        """Return the anchors among `rows` [V] int64 that are not hidden in a view."""
        if self.share <= 0.0:
            return rows
        return rows[(self.hidden[rows, view // 8] & (1 << view % 8)) == 0]

    def measured(self, gaussians: Gaussians[Tensor]) -> tuple[Gaussians[Tensor], GradientSizes]:
        """The same Gaussians, and how large their gradients are once the backward pass is over; not known where no
        anchor is ever hidden.
        """
        sizes = GradientSizes()
        return (with_gradient_sizes(gaussians, sizes) if self.share > 0.0 else gaussians), sizes

    def observe(
        self, view: int, rows: Tensor, prediction: Prediction, gaussians: Gaussians, sizes: GradientSizes
    ) -> None:
        """Look at a view after its backward pass: its anchors [V], their prediction, the Gaussians that were drawn of
        it (of opacity 0: left out by chance), and how large their gradients were.
        """
        if self.share <= 0.0:
            return
        found = torch.zeros(len(rows), dtype=torch.bool)
        # Where hardly anything is drawn, nothing is hidden by others: the scene vanishes, and is to come back.
        if sizes.values is not None and len(prediction.index) >= FEW_DRAWN * len(prediction.opacities):
            _find_hidden(
                prediction.index.numpy(),
                gaussians.opacities.detach().numpy(),
                sizes.values.numpy(),
                self.coupled_primitives,
                self.share,
                found.numpy(),
            )
        column, bit = view // 8, 1 << view % 8
        missed, hidden = self.missed[rows, column], self.hidden[rows, column]
        now = found.to(torch.uint8) << view % 8
        self.hidden[rows, column] = (hidden & (0xFF ^ bit)) | (now & missed)
        self.missed[rows, column] = (missed & (0xFF ^ bit)) | now

    def replaced(self, kept: Tensor, new: int) -> None:
        """Only the anchors `kept` [N] bool are left, and so many new ones follow."""
        none = self.hidden.new_zeros(new, self.hidden.shape[1])
        self.missed = torch.cat([self.missed[kept], none])
        self.hidden = torch.cat([self.hidden[kept], none])

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint holds."""
        return {"missed": self.missed, "hidden": self.hidden}

    def state(self) -> dict[str, Any]:
        """Nothing beside the tensors."""
        return {}

    def restore(self, tensors: Mapping[str, Tensor], state: Mapping[str, Any]) -> None:
        """Take back what a checkpoint holds; what one rank remembered is of no use to several, which remember nothing,
        nor the other way round. Raises ValueError, KeyError, IndexError for a damaged one.
        """
        anchors, columns = self.hidden.shape
        if 0 in (columns, tensors["hidden"].shape[-1]):
            check_tensor(tensors["hidden"][:, :0], (anchors, 0), torch.uint8, "hidden")
            return
        for name in ("missed", "hidden"):
            check_tensor(tensors[name], (anchors, columns), torch.uint8, name)
        self.missed, self.hidden = (tensors[name].to(self.hidden.device) for name in ("missed", "hidden"))


@njit(error_model="numpy")
def _measure(means, spreads, opacities, colors, scales, sizes):
    """sizes [M]: the mean of two shares of each primitive's gradients, in means over all of them: how it looks, and
    where and how large it is, in what no unit of length changes.
    """
    count = len(opacities)
    placed = np.empty(count, np.float32)
    all_shown = all_placed = 0.0
    for i in range(count):
        sizes[i] = abs(opacities[i]) + abs(colors[i, 0]) + abs(colors[i, 1]) + abs(colors[i, 2])
        moved = 0.0
        for c in range(3):
            moved += (abs(means[i, c]) + abs(spreads[i, c])) * scales[i, c]
        placed[i] = moved
        all_shown += sizes[i]
        all_placed += moved
    by_shown, by_placed = count / (2.0 * all_shown), count / (2.0 * all_placed)
    if not (np.isfinite(by_shown) and np.isfinite(by_placed)):
        by_shown, by_placed = np.inf, np.inf  # nothing is small beside nothing
    for i in range(count):
        sizes[i] = sizes[i] * by_shown + placed[i] * by_placed


@njit
def _find_hidden(index, opacities, sizes, k, share, hidden):
    """hidden [V]: whether the mean of an anchor's gradient sizes, of K primitives, is below `share`. Those that are not
    drawn, which `index` [M] lacks, have none; of those that were left out it is not known.
    """
    m = 0
    for anchor in range(len(hidden)):
        total, known = 0.0, k
        while m < len(index) and index[m] < (anchor + 1) * k:
            if opacities[m] > 0:
                total += sizes[m]
            else:
                known -= 1
            m += 1
        # NaN, as of a run that has diverged, hides nothing
        hidden[anchor] = known > 0 and total < share * known
