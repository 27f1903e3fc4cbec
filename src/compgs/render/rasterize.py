"""One function from Gaussians to pixels; the device decides who draws."""

import itertools
from collections.abc import Iterator
from dataclasses import fields

import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.reference import rasterize_reference
from compgs.render.result import RasterResult
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings


def rasterize(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS
) -> RasterResult:
    """Differentiable rendering: gsplat on CUDA, numba for float32 on the CPU, the reference otherwise.

    Gradients go to means, quaternions, scales, opacities and colors; cameras and settings are constants.
    """
    means = gaussians.means
    # Imported here: a renderer on the CPU needs no gsplat, one on CUDA no compiled CPU kernels.
    if means.is_cuda:
        from compgs.render.gsplat_backend import rasterize_gsplat

        return rasterize_gsplat(gaussians, camera, settings)
    if means.device.type == "cpu" and means.dtype == torch.float32:
        from compgs.render.numba_backend import rasterize_numba

        return rasterize_numba(gaussians, camera, settings)
    return rasterize_reference(gaussians, camera, settings)


@torch.no_grad()
def rasterize_parts(
    parts: Iterator[Gaussians], most: int, camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS
) -> RasterResult:
    """The image of all parts (one at least; at most `most` Gaussians together), without gradients. On the CPU no two of
    them are in memory at once.
    """
    first = next(parts)
    every = itertools.chain([first], parts)
    if first.means.device.type == "cpu" and first.means.dtype == torch.float32:
        from compgs.render.numba_backend import draw_parts

        del first
        return draw_parts(every, most, camera, settings)
    values = zip(*([getattr(part, f.name) for f in fields(part)] for part in every), strict=True)
    return rasterize(Gaussians(*(torch.cat(value) for value in values)), camera, settings)
