"""Primitives that are left out of a training step by chance (as DropGaussian; Park et al. 2025).

Where few views look, a handful of primitives in front of each camera can explain its photograph and be wrong from
everywhere else. Whatever must do without some of its neighbours now and then cannot rely on such a trick. With many
views there is nothing to gain (docs/results/decisions.md).
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from compgs.gaussians import Gaussians
from compgs.tensors.prediction import Prediction


def thinned(prediction: Prediction, share: float, noise: Callable[[Tensor], Tensor]) -> Gaussians:
    """The Gaussians, a random `share` of them with opacity 0, the others with more, so that the mean stays.

    `noise`: uniform in [-0.5, 0.5), of the shape of what it is given: all coupled primitives, so that chance does not
    depend on which of them were predicted at all.
    """
    gaussians = prediction.gaussians
    if share <= 0.0:
        return gaussians
    chance = noise(prediction.opacities).index_select(0, prediction.index)
    weight = torch.where(chance < share - 0.5, 0.0, 1.0 / (1.0 - share))
    # Those that make up for the others stay below 1.
    return replace(gaussians, opacities=(gaussians.opacities * weight).clamp_max(0.9999))
