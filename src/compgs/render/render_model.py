"""The public face of rendering: a decoded or trained scene, seen from a camera."""

from typing import Protocol

import torch

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.rasterize import rasterize
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.visibility import visible_mask


class Renderable(Protocol):
    """Anything that says which Gaussians a camera sees.

    A model with `bounds` (centres [N, 3] and radii [N] of its anchors) is asked for the anchors in view only,
    as `gaussians(camera, visible)`.
    """

    @property
    def background(self) -> tuple[float, float, float]: ...

    def gaussians(self, camera: Camera) -> Gaussians: ...


@torch.no_grad()
def render(model: Renderable, camera: Camera, settings: RasterSettings | None = None) -> RasterResult:
    """One view of a scene, without gradients. By default over the model's own background."""
    settings = settings or RasterSettings(background=model.background)
    bounds = getattr(model, "bounds", None)
    if bounds is None:
        gaussians = model.gaussians(camera)
    else:
        gaussians = model.gaussians(camera, visible_mask(*bounds, camera, settings))  # type: ignore[call-arg]
    return rasterize(gaussians, camera, settings)
