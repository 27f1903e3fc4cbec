"""What each splat adds to the training views, and which splats are the ones to do without."""

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.render import RasterSettings
from compgs.tensors.contributions import contributions
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask


@torch.no_grad()
def blending_weights(
    splats: Splats, cameras: Iterable[Camera], settings: RasterSettings
) -> Iterator[tuple[Camera, Tensor]]:
    """Return for each camera (of the splats' frame) the sums over its pixels of transmittance x alpha, [M] float32."""
    for camera in cameras:
        weights = splats.means.new_zeros(len(splats))
        rows = torch.nonzero(visible_mask(splats.means, splat_radii(splats), camera, settings)).view(-1)
        if len(rows):
            # Whatever their colors: of degree 0 they cost nothing.
            gaussians = splat_gaussians(splats.rows(rows), camera, 0)
            weights[rows] = contributions(gaussians, camera, settings)
        yield camera, weights


@torch.no_grad()
def view_significance(splats: Splats, cameras: Iterable[Camera], settings: RasterSettings) -> Tensor:
    """[M] float64, pixels: transmittance x alpha of each splat, summed over all pixels of all cameras."""
    total = torch.zeros(len(splats), dtype=torch.float64, device=splats.means.device)
    for _, weights in blending_weights(splats, cameras, settings):
        total += weights.double()
    return total


def all_but_lowest(values: Tensor, share: float) -> Tensor:
    """[M] bool, False for the lowest values [M]: floor(share x M) of them, and at least one splat stays. Of equal ones
    the first go."""
    removed = min(int(share * len(values)), max(0, len(values) - 1))
    kept = torch.ones(len(values), dtype=torch.bool, device=values.device)
    kept[torch.sort(values, stable=True).indices[:removed]] = False
    return kept
