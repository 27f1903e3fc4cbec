"""What each coupled primitive adds to the training views, and which ones they would miss.

A primitive's *contribution* is the sum of its blending weights (transmittance times alpha) over the pixels of the
views: what it adds to them, whatever its color. Anchors that add least are pruned while the others can still make up
for them, and what hardly adds anything is left out of the file.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.model.prediction import Prediction
from compgs.render import RasterSettings, contributions
from compgs.scene.views import View

# Views that a mere look at the size takes, and a pruning, which the rest of the run makes up for: of more, as many
# spread over all. What the file leaves out at the end is decided by all views: of one of them it might be the only one.
LOOKED_AT, PRUNED_BY = 48, 256


def spread(views: Sequence[View], most: int) -> Sequence[View]:
    """At most so many of the views, evenly spread over their order."""
    if len(views) <= most:
        return views
    return [views[i * len(views) // most] for i in range(most)]


@torch.no_grad()
def view_contributions(
    views: Sequence[View],
    predicted: Callable[[Camera], tuple[Tensor, Prediction] | None],
    shape: tuple[int, int],  # N, K
    settings: RasterSettings,
    device: torch.device,
) -> Tensor:  # [N, K] float64, pixels
    """Of all coupled primitives to the views. `predicted`: visible anchors [V] and their prediction, None: none are."""
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


def missed(contributions: Tensor, idle_share: float) -> Tensor:
    """[N, K] bool: coupled primitives that the views would miss, by their contributions [N, K]."""
    return worth_keeping(contributions.view(-1), idle_share).view_as(contributions)
