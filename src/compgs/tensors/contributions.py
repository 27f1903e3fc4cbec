"""How much of an image each Gaussian is, and how it would change without it, on torch tensors;
`render/contributions.py` has the first on arrays.
"""

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


def signed_changes(
    gaussians: Gaussians[Tensor],  # M
    camera: Camera,
    signs: Tensor,  # [H, W, 3] what a change of each value counts
    settings: RasterSettings = DEFAULT_SETTINGS,
) -> Tensor:  # [M]
    """Return by how much each Gaussian alone changes the image, all values x `signs` summed: with it minus without it.

    What is behind a Gaussian shows where it is not. A pixel is affine in a Gaussian's opacity, as long as that does not
    reach the cap: opacity x derivative is the change. Of several Gaussians together the sum is what they change if they
    do not cover each other.
    """
    opacities = gaussians.opacities.detach().requires_grad_()
    with torch.enable_grad():
        image = rasterize(replace(gaussians, opacities=opacities), camera, settings).image
        (gradient,) = torch.autograd.grad(image, opacities, signs)
    return gradient * gaussians.opacities.detach()
