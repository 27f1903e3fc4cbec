"""Rasterization on the CPU with gradients: the kernels of `render` behind autograd.

means, quaternions, scales ──Project──► means2d, covariances ─┐
opacities, colors ────────────────────────────────────────────┴──Blend──► image, transmittance
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.binning import TileLists, bin_splats
from compgs.render.projection import camera_numbers, project_backward, project_forward
from compgs.render.rasterize import blend, blend_gradients
from compgs.render.rasterize import rasterize as rasterize_arrays
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings


def rasterize_numba(
    gaussians: Gaussians[Tensor], camera: Camera, settings: RasterSettings
) -> RasterResult[Tensor]:
    """float32 tensors on the CPU."""
    if not wants_gradients(gaussians):
        return draw(gaussians, camera, settings)
    means2d, covariances, depths, determinants = Project.apply(
        gaussians.means, gaussians.quaternions, gaussians.scales, camera_numbers(camera, settings)
    )
    image, transmittance, visible = Blend.apply(
        means2d, covariances, gaussians.opacities, gaussians.colors, depths, determinants, camera, settings
    )
    return RasterResult(image, transmittance, means2d, visible)


def wants_gradients(gaussians: Gaussians[Tensor]) -> bool:
    """Whether what is drawn of them shall be differentiated."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors_of(gaussians))


def tensors_of(gaussians: Gaussians[Tensor]) -> tuple[Tensor, ...]:
    g = gaussians
    return g.means, g.quaternions, g.scales, g.opacities, g.colors


def draw(gaussians: Gaussians[Tensor], camera: Camera, settings: RasterSettings) -> RasterResult[Tensor]:
    """The same image where no gradient is wanted."""
    arrays = Gaussians(*(as_array(value) for value in tensors_of(gaussians)))
    drawn = rasterize_arrays(arrays, camera, settings)
    return RasterResult(*(torch.from_numpy(value) for value in vars(drawn).values()))


class Project(torch.autograd.Function):
    """means2d [M, 2], covariances [M, 3] (xx, xy, yy); without gradient: depths [M], determinants [M]."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quaternions: Tensor, scales: Tensor, numbers: np.ndarray
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        m = len(means)
        means2d, covariances = means.new_empty(m, 2), means.new_empty(m, 3)
        depths, determinants = means.new_empty(m), means.new_empty(m)
        project_forward(
            as_array(means),
            as_array(quaternions),
            as_array(scales),
            numbers,
            as_array(means2d),
            as_array(covariances),
            as_array(depths),
            as_array(determinants),
        )
        ctx.save_for_backward(means, quaternions, scales, depths)
        ctx.numbers = numbers
        ctx.mark_non_differentiable(depths, determinants)
        return means2d, covariances, depths, determinants

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, quaternions, scales, depths = ctx.saved_tensors
        grad_means, grad_quaternions, grad_scales = (
            torch.empty(t.shape) for t in (means, quaternions, scales)
        )
        project_backward(
            as_array(means),
            as_array(quaternions),
            as_array(scales),
            ctx.numbers,
            as_array(depths),
            as_array(gradients[0]),
            as_array(gradients[1]),
            as_array(grad_means),
            as_array(grad_quaternions),
            as_array(grad_scales),
        )
        return grad_means, grad_quaternions, grad_scales, None


class Blend(torch.autograd.Function):
    """image [H, W, 3], transmittance [H, W]; without gradient: visible [M]."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        covariances: Tensor,
        opacities: Tensor,
        colors: Tensor,
        depths: Tensor,
        determinants: Tensor,
        camera: Camera,
        settings: RasterSettings,
    ) -> tuple[Tensor, Tensor, Tensor]:
        lists = bin_splats(
            means2d=as_array(means2d),
            covariances=as_array(covariances),
            determinants=as_array(determinants),
            depths=as_array(depths),
            opacities=as_array(opacities),
            colors=as_array(colors),
            width=camera.width,
            height=camera.height,
            settings=settings,
        )
        drawn, through, ends = blend(lists, camera, settings)
        image, transmittance = torch.from_numpy(drawn), torch.from_numpy(through)
        ctx.lists, ctx.ends, ctx.settings = lists, ends, settings
        ctx.save_for_backward(image, transmittance, opacities)
        visible_mask = torch.from_numpy(lists.visible)
        ctx.mark_non_differentiable(visible_mask)
        return image, transmittance, visible_mask

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        lists: TileLists = ctx.lists
        image, transmittance, opacities = ctx.saved_tensors
        found = blend_gradients(
            lists,
            ctx.ends,
            as_array(image),
            as_array(transmittance),
            as_array(opacities),
            ctx.settings,
            as_array(gradients[0]),
            as_array(gradients[1]),
        )
        by_means2d, by_covariances, by_opacities, by_colors = map(torch.from_numpy, vars(found).values())
        return by_means2d, by_covariances, by_opacities, by_colors, None, None, None, None


def as_array(tensor: Tensor) -> np.ndarray:
    """The tensor's own memory; a copy only where it is not contiguous."""
    return tensor.detach().contiguous().numpy()
