"""From Gaussians to pixels: one function, three backends: torch (reference), numba (CPU), gsplat (CUDA)."""

from compgs.render.rasterize import rasterize
from compgs.render.render import render
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.visibility import visible_mask

__all__ = ["RasterResult", "RasterSettings", "rasterize", "render", "visible_mask"]
