"""What each coupled primitive adds to the training views, and which ones they would miss.

A primitive's *contribution* is the sum of its blending weights (transmittance times alpha) over the pixels of the
views: what it adds to them, whatever its color. What hardly adds anything is left out of the file. (Prunings in
a run go by `pruning.py`.)
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.numerics.evenly import evenly
from compgs.render import RasterSettings
from compgs.scene.views import View
from compgs.tensors.contributions import contributions
from compgs.tensors.prediction import Prediction


def spread(views: Sequence[View], most: int) -> Sequence[View]:
    """Choose at most `most` of the views, evenly spread over their order."""
    return [views[i] for i in evenly(len(views), most)]


@torch.no_grad()
def view_contributions(
    views: Sequence[View],
    predicted: Callable[[Camera], tuple[Tensor, Prediction] | None],
    shape: tuple[int, int],  # N, K
    settings: RasterSettings,
    device: torch.device,
) -> Tensor:  # [N, K] float64, pixels
    """Contributions of all coupled primitives to the views.

    `predicted`: for a camera, the visible anchors [V] and their prediction, or None if no anchor is visible.
    """
    total = torch.zeros(shape[0] * shape[1], dtype=torch.float64, device=device)
    for view in views:
        seen = predicted(view.camera)
        if seen is None:
            continue
        rows, prediction = seen
        slots = rows[prediction.index // shape[1]] * shape[1] + prediction.index % shape[1]
        # Each slot comes once: no sum depends on an order.
        total[slots] += contributions(prediction.gaussians, view.camera, settings).double()
    return total.view(shape)


def worth_keeping(contributions: Tensor, share: float) -> Tensor:
    """[P] bool: all but the smallest contributions [P], which together make up at most `share` of the sum."""
    ascending = contributions.sort(stable=True)
    idle = ascending.values.cumsum(0) <= share * contributions.sum()
    kept = contributions > 0
    kept[ascending.indices[idle]] = False
    return kept


def needed_primitives(contributions: Tensor, idle_share: float) -> Tensor:
    """[N, K] bool: coupled primitives that the views would miss, by their contributions [N, K]."""
    return worth_keeping(contributions.view(-1), idle_share).view_as(contributions)
