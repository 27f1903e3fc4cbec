"""Rasterization on the CPU: projection, binning and blending behind autograd.

means, quaternions, scales ──Project──► means2d, covariances ─┐
opacities, colors ────────────────────────────────────────────┴──Blend──► image, transmittance
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.binning import PARAMETERS, TileLists, bin_splats, list_tiles, pack_splats
from compgs.render.projection import Project, as_array, camera_numbers, project_forward
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.tiles import MOMENTS, blend_backward, blend_forward, sum_moments


def rasterize_numba(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> RasterResult:
    """float32 tensors on the CPU."""
    if not (torch.is_grad_enabled() and any(t.requires_grad for t in tensors_of(gaussians))):
        return draw(gaussians, camera, settings)
    means2d, covariances, depths, determinants = Project.apply(
        gaussians.means, gaussians.quaternions, gaussians.scales, camera_numbers(camera, settings)
    )
    image, transmittance, visible = Blend.apply(
        means2d, covariances, gaussians.opacities, gaussians.colors, depths, determinants, camera, settings
    )
    return RasterResult(image, transmittance, means2d, visible)


def tensors_of(gaussians: Gaussians) -> tuple[Tensor, ...]:
    g = gaussians
    return g.means, g.quaternions, g.scales, g.opacities, g.colors


def draw(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> RasterResult:
    """The same image where no gradient is wanted."""
    return draw_parts([gaussians], len(gaussians), camera, settings)


@torch.no_grad()
def draw_parts(
    parts: Iterable[Gaussians], most: int, camera: Camera, settings: RasterSettings
) -> RasterResult:
    """Of Gaussians that come in parts, at most `most` together; no two parts need be in memory."""
    packed, depths = np.empty((most, PARAMETERS), np.float32), np.empty(most, np.float32)
    determinants = np.empty(most, np.float32)
    numbers = camera_numbers(camera, settings)
    m = 0
    for gaussians in parts:
        rows = slice(m, m + len(gaussians))
        # In the columns that they give way to: memory that is not touched costs nothing.
        project_forward(
            as_array(gaussians.means),
            as_array(gaussians.quaternions),
            as_array(gaussians.scales),
            numbers,
            packed[rows, 0:2],
            packed[rows, 2:5],
            depths[rows],
            determinants[rows],
        )
        packed[rows, 5] = as_array(gaussians.opacities)
        packed[rows, 6:9] = as_array(gaussians.colors)
        m += len(gaussians)
        del gaussians
    packed, depths = packed[:m], depths[:m]
    splats = pack_splats(
        means2d=packed[:, 0:2],
        covariances=packed[:, 2:5],
        determinants=determinants[:m],
        depths=depths,
        opacities=packed[:, 5],
        colors=packed[:, 6:9],
        width=camera.width,
        height=camera.height,
        settings=settings,
        packed=packed,
    )
    del determinants
    lists = list_tiles(splats, depths)
    image, transmittance, _ = blend(lists, camera, settings)
    del splats, depths
    means2d = torch.from_numpy(packed[:, 0:2].copy())
    return RasterResult(image, transmittance, means2d, torch.from_numpy(lists.visible))


def blend(lists: TileLists, camera: Camera, settings: RasterSettings) -> tuple[Tensor, Tensor, np.ndarray]:
    """image [H, W, 3], transmittance [H, W], and per tile the entry after the last one needed."""
    image = torch.empty(camera.height, camera.width, 3)
    transmittance = torch.empty(camera.height, camera.width)
    ends = np.empty(len(lists.starts) - 1, np.int64)
    blend_forward(
        lists.packed,
        lists.starts,
        lists.entries,
        lists.order,
        np.array(settings.background, np.float32),
        *blend_thresholds(settings),
        image.numpy(),
        transmittance.numpy(),
        ends,
    )
    return image, transmittance, ends


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
        image, transmittance, ends = blend(lists, camera, settings)
        ctx.lists, ctx.ends, ctx.thresholds = lists, ends, blend_thresholds(settings)
        ctx.save_for_backward(image, transmittance, opacities)
        visible_mask = torch.from_numpy(lists.visible)
        ctx.mark_non_differentiable(visible_mask)
        return image, transmittance, visible_mask

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        lists: TileLists = ctx.lists
        image, transmittance, opacities = ctx.saved_tensors
        cutoff, cap, stop = ctx.thresholds
        moments = np.empty((len(lists.entries), MOMENTS), np.float32)
        blend_backward(
            lists.packed,
            lists.starts,
            lists.entries,
            lists.order,
            ctx.ends,
            cutoff,
            cap,
            stop,
            as_array(image),
            as_array(transmittance),
            as_array(gradients[0]),
            as_array(gradients[1]),
            moments,
        )
        m = len(opacities)
        grad_means2d, grad_covariances = image.new_empty(m, 2), image.new_empty(m, 3)
        grad_opacities, grad_colors = image.new_empty(m), image.new_empty(m, 3)
        sum_moments(
            lists.visible,
            lists.packed,
            lists.first_slot,
            lists.slots_used,
            lists.slots,
            moments,
            as_array(opacities),
            as_array(grad_means2d),
            as_array(grad_covariances),
            as_array(grad_opacities),
            as_array(grad_colors),
        )
        return grad_means2d, grad_covariances, grad_opacities, grad_colors, None, None, None, None


def blend_thresholds(settings: RasterSettings) -> tuple[np.float32, np.float32, np.float32]:
    """Alpha cutoff, alpha cap, and the transmittance at which a pixel is finished."""
    return (
        np.float32(settings.alpha_cutoff),
        np.float32(settings.alpha_cap),
        np.float32(settings.transmittance_stop),
    )
