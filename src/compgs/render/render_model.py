"""The public face of rendering: a decoded or trained scene, seen from a camera."""

import functools
from typing import Any, Protocol, runtime_checkable

import torch

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.gaussians import Gaussians
from compgs.render.rasterize import rasterize, rasterize_parts
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.visibility import visible_mask


@runtime_checkable
class Renderable(Protocol):
    """Anything that says which Gaussians a camera sees.

    A model with `bounds` (centres [N, 3] and radii [N] of its anchors) is asked for the anchors in view only,
    as `gaussians(camera, visible)`; one that also has `parts` for what they have, at most `coupled`, a part at a time.
    A model with a `world_offset` (3 numbers, world units) is asked in its local frame, world minus offset.
    """

    @property
    def background(self) -> tuple[float, float, float]: ...

    def gaussians(self, camera: Camera) -> Gaussians: ...


def local_camera(model: Any, camera: Camera) -> Camera:
    """A camera of the world in the model's own frame, moved in double precision: where the two meet."""
    return _moved(camera, getattr(model, "world_offset", (0.0, 0.0, 0.0)))


@functools.lru_cache(maxsize=4096)
def _moved(camera: Camera, offset: tuple[float, float, float]) -> Camera:
    """Kept: what others keep for a camera is then found again in the next frame."""
    return camera.moved(offset)


@runtime_checkable
class Trained(Protocol):
    """What training gives: it can be rendered as what a decoder would make of it."""

    def as_hybrid_model(self) -> Renderable: ...


@torch.no_grad()
def render(
    model: Renderable | Trained, camera: Camera, settings: RasterSettings | None = None
) -> RasterResult:
    """One view of a scene, without gradients, from a camera of the world. By default over the model's own background.

    A trained model is quantized anew for each view; for many views, render its `as_hybrid_model()`. Raises ConfigError
    for what is no model.
    """
    if isinstance(model, Trained):
        model = model.as_hybrid_model()
    if not isinstance(model, Renderable):
        raise ConfigError(
            f"model: expected what compgs.train or compgs.decode gives, found {type(model).__name__}"
        )
    camera = local_camera(model, camera)
    settings = settings or RasterSettings(background=model.background)
    bounds = getattr(model, "bounds", None)
    if bounds is None:
        return rasterize(model.gaussians(camera), camera, settings)
    centers, radii = bounds
    visible = visible_mask(centers, radii, camera, settings)
    if hasattr(model, "parts"):
        return rasterize_parts(model.parts(camera, visible), model.coupled, camera, settings)  # type: ignore[attr-defined]
    return rasterize(model.gaussians(camera, visible), camera, settings)  # type: ignore[call-arg]
