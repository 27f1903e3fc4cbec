"""References in their principal axes: the same scene in fewer bits.

Every channel of a reference embedding is quantized and coded for itself, given a hyperprior of a few channels: what
channels have in common is paid for more than once. All that reads references, the prediction heads and the entropy
model, begins with a linear layer. So for any orthonormal U

    references U,    weights U^T in those layers

is the same scene, with rounding errors of the same size. Of all U the principal axes of the references (the
Karhunen-Loeve transform; Goyal 2001, "Theoretical foundations of transform coding") leave Gaussian channels the least
bits, and the file needs nothing new: the weights that it holds anyway absorb U. Anchors still move and come, so that it
is done several times in a run.
"""

import numpy as np
import torch
from torch import Tensor

from compgs.linear import transposed_product
from compgs.trained_model import TrainedModel


@torch.no_grad()
def principal_axes(references: Tensor) -> Tensor:
    """[C, C] orthonormal columns: the axes of references [N, C], largest variance first. They are not unique where
    variances are equal, as with fewer anchors than channels.
    """
    centered = references - references.mean(0)
    if centered.device.type == "cpu" and centered.dtype == torch.float32:
        scatter = transposed_product(centered, centered)
    else:
        scatter = centered.t() @ centered
    axes = np.linalg.eigh(scatter.double().cpu().numpy())[1]
    return torch.from_numpy(axes[:, ::-1].copy()).to(references)


@torch.no_grad()
def decorrelate(model: TrainedModel, optimizer: torch.optim.Optimizer) -> None:
    """Turn the references into their principal axes, and with them all that reads them and Adam's moments."""
    if not torch.isfinite(model.references).all():
        return  # the run has diverged, and the next step will say so
    axes = principal_axes(model.references)
    for parameter, dimension, first in model.along_references():
        _turn(parameter, dimension, first, axes)
        state = optimizer.state.get(parameter, {})
        if "exp_avg" in state:
            _turn(state["exp_avg"], dimension, first, axes)
            # Of uncorrelated gradients, the only ones of which these alone would be enough.
            _turn(state["exp_avg_sq"], dimension, first, axes.square())
    for parameter in model.entropy.restart_reference_scales(model.references):
        state = optimizer.state.get(parameter, {})
        if "exp_avg" in state:
            state["exp_avg"][model.config.model.reference_dim :] = 0


def _turn(x: Tensor, dimension: int, first: int, matrix: Tensor) -> None:
    """x <- x times matrix [C, C] along `dimension`, of which the C entries from `first` on are meant."""
    part = x.narrow(dimension, first, len(matrix))
    part.copy_((part.movedim(dimension, -1) @ matrix).movedim(-1, dimension))
