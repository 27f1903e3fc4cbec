"""How much the training views depend on each splat's color and shape.

The sensitivity of a number is the sum over the views of |d (sum of the image) / d number|, over the pixels of all of
them; a vector's is that of its most sensitive number. Images are drawn in front of black, and colors below 0 count as
they are.

The sum of an image changes with a harmonic coefficient by the value of its basis function times the splat's blending
weights. Of the shape, what is looked at are the logarithms of the three scales: they are three of its six directions,
and the only ones in which the gradient is known wherever two scales are equal.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.model.spherical_harmonics import COLOR_OFFSET
from compgs.render import RasterSettings
from compgs.tensors.rasterize import rasterize
from compgs.tensors.spherical_harmonics import harmonic_basis
from compgs.tensors.splats import Splats, splat_gaussians, splat_radii
from compgs.tensors.visibility import visible_mask


def sensitivities(
    splats: Splats, cameras: Sequence[Camera], settings: RasterSettings
) -> tuple[Tensor, Tensor]:
    """Measure the sensitivities of colors and of shapes, [M] float32 each, 1 / pixel."""
    black = replace(settings, background=(0.0, 0.0, 0.0))
    count, coefficients = len(splats), 1 + splats.rest.shape[1]
    colors = splats.means.new_zeros(count, coefficients)
    shapes = splats.means.new_zeros(count, 3)
    pixels = sum(camera.width * camera.height for camera in cameras)
    for camera in cameras:
        rows = torch.nonzero(visible_mask(splats.means, splat_radii(splats), camera, black)).view(-1)
        if len(rows):
            weights, basis, scales = _of_view(splats.rows(rows), camera, black)
            colors[rows] += weights[:, None].abs() * basis.abs()
            shapes[rows] += scales.abs()
    return colors.amax(1) / pixels, shapes.amax(1) / pixels


def _of_view(splats: Splats, camera: Camera, settings: RasterSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Blending weights [V], values of the harmonics [V, K], derivatives by the logs of the scales [V, 3]."""
    with torch.no_grad():
        center = torch.as_tensor(camera.center, dtype=splats.means.dtype, device=splats.means.device)
        directions = torch.nn.functional.normalize(splats.means - center, dim=1)
        basis = harmonic_basis(directions, splats.degree)
        values = torch.cat([splats.dc[:, None], splats.rest], 1)
        seen = COLOR_OFFSET + (basis[:, :, None] * values).sum(1)
        gaussians = splat_gaussians(splats, camera, 0)
    colors, scales = seen.requires_grad_(), gaussians.scales.detach().requires_grad_()
    with torch.enable_grad():
        image = rasterize(replace(gaussians, colors=colors, scales=scales), camera, settings).image
        by_colors, by_scales = torch.autograd.grad(image.sum(), (colors, scales))
    return by_colors[:, 0], basis, by_scales * scales.detach()
