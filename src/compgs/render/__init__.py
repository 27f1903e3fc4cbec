"""From Gaussians to pixels, on numpy arrays: what a decoded scene needs to be looked at (`tensors` has gradients)."""

import sys
from types import ModuleType
from typing import Any

from compgs.render.contributions import Blended, contributions
from compgs.render.rasterize import blended, rasterize
from compgs.render.render_model import Renderable, blend_of, local_camera, render, settings_of
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.visibility import visible_mask

__all__ = [
    "Blended",
    "RasterResult",
    "RasterSettings",
    "Renderable",
    "blend_of",
    "blended",
    "contributions",
    "local_camera",
    "rasterize",
    "render",
    "settings_of",
    "visible_mask",
]


class _CallablePackage(ModuleType):
    """`compgs.render` names a package and, in the public face, a function: calling the package renders."""

    def __call__(self, *args: Any, **kwargs: Any) -> RasterResult[Any]:
        return render(*args, **kwargs)


sys.modules[__name__].__class__ = _CallablePackage
