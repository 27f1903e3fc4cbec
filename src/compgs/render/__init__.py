"""From Gaussians to pixels: one function, three backends: torch (reference), numba (CPU), gsplat (CUDA)."""

import sys
from types import ModuleType
from typing import Any

from compgs.render.contributions import contributions
from compgs.render.rasterize import rasterize
from compgs.render.render_model import Renderable, local_camera, render
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.visibility import visible_mask

__all__ = [
    "RasterResult",
    "RasterSettings",
    "Renderable",
    "contributions",
    "local_camera",
    "rasterize",
    "render",
    "visible_mask",
]


class _CallablePackage(ModuleType):
    """`compgs.render` names a package and, in the public face, a function: calling the package renders."""

    def __call__(self, *args: Any, **kwargs: Any) -> RasterResult:
        return render(*args, **kwargs)


sys.modules[__name__].__class__ = _CallablePackage
