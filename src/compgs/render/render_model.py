"""The public face of rendering: a decoded or trained scene, seen from a camera."""

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.gaussians import Gaussians
from compgs.render.contributions import Blend, Blended
from compgs.render.rasterize import blended, rasterize_parts
from compgs.render.result import RasterResult
from compgs.render.settings import RasterSettings
from compgs.render.visibility import visible_mask


@runtime_checkable
class Renderable(Protocol):
    """A scene: says which Gaussians a camera sees. What a decoder, a reader of a file or a training gives.

    Everything is in the model's local frame, world coordinates minus `world_offset`, on numpy arrays.
    """

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB, 0 to 1."""
        ...

    @property
    def angular_dilation(self) -> float | None:
        """Says how far splats are dilated, as `RasterSettings.angular_dilation`; None: the same pixels in pictures of
        every size.
        """
        ...

    @property
    def antialiased(self) -> bool:
        """Says whether opacities make up for the dilation, as `RasterSettings.antialiased`."""
        ...

    @property
    def world_offset(self) -> tuple[float, float, float]:
        """World units, float64: origin of the local frame."""
        ...

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Spheres that hold all that is drawn of a unit (anchor, splat): centres [N, 3] and radii [N], world units."""
        ...

    @property
    def viewpoints(self) -> tuple[Camera, ...]:
        """Cameras of the world to look from, the best first; none where the file keeps none."""
        ...

    @property
    def counts(self) -> Mapping[str, int]:
        """What there is how many of, by the names of `Results`: `splats`, or `anchors` and `coupled_primitives`."""
        ...

    @property
    def most_gaussians(self) -> int:
        """That a camera can see."""
        ...

    def over(self, background: tuple[float, float, float]) -> "Renderable":
        """The same over another background."""
        ...

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        """What a camera sees of the units of a mask [N] bool, or of all."""
        ...

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        """The same, a part at a time, so that not all need be in memory; one part at least."""
        ...


def settings_of(model: Renderable, background: tuple[float, float, float] | None = None) -> RasterSettings:
    """How a scene is drawn, over its own background or another."""
    behind = model.background if background is None else background
    return RasterSettings(
        background=behind, angular_dilation=model.angular_dilation, antialiased=model.antialiased
    )


def local_camera(model: Renderable, camera: Camera) -> Camera:
    """A camera of the world in the model's own frame, moved in double precision: where the two meet."""
    return _moved(camera, model.world_offset)


@functools.lru_cache(maxsize=4096)
def _moved(camera: Camera, offset: tuple[float, float, float]) -> Camera:
    """Kept: what others keep for a camera is then found again in the next frame."""
    return camera.moved(offset)


@runtime_checkable
class DrawsItself(Protocol):
    """A scene that lives on another device than the CPU, and is drawn there; what it gives are numpy arrays."""

    def draw(self, camera: Camera, settings: RasterSettings) -> RasterResult[np.ndarray]:
        """What a camera of the model's frame sees."""
        ...

    def blended(self, gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings) -> Blended:
        """The image of Gaussians, which need not be the scene's own, with its gradients."""
        ...


@runtime_checkable
class Trained(Protocol):
    """What training gives: it can be rendered as what a decoder would make of it."""

    def as_hybrid_model(self) -> Renderable: ...


class HasCamera(Protocol):
    """Such as a view of a scene."""

    @property
    def camera(self) -> Camera: ...


def render(
    model: Renderable | Trained, camera: "Camera | HasCamera", settings: RasterSettings | None = None
) -> RasterResult[np.ndarray]:
    """One view of a scene, from a camera of the world, or that of a view, as numpy arrays. By default as `settings_of`
    has it.

    A trained model is quantized anew for each view; for many views, render its `as_hybrid_model()`. Raises ConfigError
    for what is no model.
    """
    if isinstance(model, Trained):
        model = model.as_hybrid_model()
    if not isinstance(model, Renderable):
        hint = "; compgs.open_scene(path) opens a file" if isinstance(model, (str, os.PathLike)) else ""
        raise ConfigError(
            f"model: expected what compgs.train or compgs.decode gives, found {type(model).__name__}{hint}"
        )
    camera = local_camera(model, _camera_of(camera))
    settings = settings or settings_of(model)
    if isinstance(model, DrawsItself):
        return model.draw(camera, settings)
    centers, radii = model.bounds
    visible = visible_mask(centers, radii, camera, settings)
    return rasterize_parts(model.parts(camera, visible), model.most_gaussians, camera, settings)


def _camera_of(given: "Camera | HasCamera") -> Camera:
    """Raises ConfigError for what has no camera."""
    camera = getattr(given, "camera", given)
    if isinstance(camera, Camera):
        return camera
    hint = "; render its cameras one by one" if isinstance(given, Sequence) else ""
    raise ConfigError(
        f"camera: expected a compgs.Camera or a view of a scene, found {type(given).__name__}{hint}"
    )


def blend_of(model: Renderable) -> Blend:
    """The function that draws Gaussians, with gradients, where the model is drawn."""
    return model.blended if isinstance(model, DrawsItself) else blended
