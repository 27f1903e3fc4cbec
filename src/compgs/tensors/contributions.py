"""How much of an image each Gaussian is, on torch tensors; `render/contributions.py` has the same on arrays."""

from dataclasses import replace

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings
from compgs.tensors.rasterize import rasterize


def contributions(
    gaussians: Gaussians[Tensor],  # M
    camera: Camera,
    settings: RasterSettings = DEFAULT_SETTINGS,
) -> Tensor:  # [M] pixels
    """Transmittance x alpha of each Gaussian, summed over the image's pixels.

    A pixel is the sum of weight x color: the derivative of the summed red channel by a Gaussian's red is the sum of its
    weights. So every backend that has gradients has contributions, and none needs another kernel.
    """
    colors = gaussians.colors.detach().requires_grad_()
    with torch.enable_grad():
        image = rasterize(replace(gaussians, colors=colors), camera, settings).image
        (gradient,) = torch.autograd.grad(image[..., 0].sum(), colors)
    return gradient[:, 0]
