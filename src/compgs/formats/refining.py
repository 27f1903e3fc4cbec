"""Splats, fitted to the renderings of the scene they were made from: the last tenths of a decibel."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from compgs.cameras import Camera
from compgs.formats.baking import Baked
from compgs.gaussians import Gaussians
from compgs.model.spherical_harmonics import view_colors, view_colors_gradient
from compgs.model.splats import SplatArrays, sigmoid, splat_radii
from compgs.render import RasterSettings, Renderable, blend_of, local_camera, render, visible_mask

# Learning rates at the beginning; they fall to LAST_RATE of it. Four times more shakes what was right already: in
# pictures of 1 280 pixels, where baking alone is 46 to 54 dB from the scene, it loses up to 2 dB; these gain 0.4 dB.
RATES = {"opacity_logits": 0.005, "dc": 0.00125, "rest": 0.0005}
LAST_RATE = 0.1


def refine(
    baked: Baked,
    model: Renderable,
    cameras: Sequence[Camera],  # of the world
    steps: int,
    progress: Callable[[], None] | None = None,  # called after each step
    settings: RasterSettings
    | None = None,  # with which the splats are drawn; as other programs do if not given
) -> Baked:
    """The same splats, with opacities and harmonics fitted to the model's own renderings, mean squared error.

    Cameras are taken in a fixed order; their pictures are kept. Geometry stays: it is that of
    the model, and fitting it too gains nothing.
    """
    settings = settings or RasterSettings(background=model.background)
    splats = baked.splats
    moving = {name: Adam(getattr(splats, name)) for name in RATES if getattr(splats, name).size}
    pictures: dict[int, np.ndarray] = {}
    for step in range(steps):
        # Neighbours in the list are neighbours in space: large strides see everything early.
        index = step * _stride(len(cameras)) % len(cameras)
        if index not in pictures:
            pictures[index] = render(model, cameras[index]).image
        gradients = _gradients(splats, model, local_camera(model, cameras[index]), pictures[index], settings)
        decay = LAST_RATE ** (step / steps)
        moved = {name: adam.moved(gradients[name], RATES[name] * decay) for name, adam in moving.items()}
        splats = with_values(splats, moved)
        if progress:
            progress()
    return replace(baked, splats=splats)


def with_values(splats: SplatArrays, values: dict[str, np.ndarray]) -> SplatArrays:
    """Other arrays, by name."""
    return SplatArrays(**{**vars(splats), **values})


def _gradients(
    splats: SplatArrays, model: Renderable, camera: Camera, picture: np.ndarray, settings: RasterSettings
) -> dict[str, np.ndarray]:
    """Return gradients of the mean squared difference to a picture [H, W, 3] from a camera of the model's frame, by
    what is fitted.
    """
    seen = np.flatnonzero(visible_mask(splats.means, splat_radii(splats.log_scales), camera, settings))
    means, rest = splats.means[seen], splats.rest[seen]
    opacities = sigmoid(splats.opacity_logits[seen])
    colors = view_colors(means, splats.dc[seen], rest, camera.center)
    scales = np.exp(splats.log_scales[seen])
    gaussians = Gaussians(means, splats.quaternions[seen], scales, opacities, colors)
    drawn = blend_of(model)(gaussians, camera, settings)
    d_image = (drawn.image - picture) * np.float32(2 / picture.size)
    d_opacities, d_colors = drawn.gradients(d_image)
    d_dc, d_rest = view_colors_gradient(means, rest, camera.center, colors, d_colors)
    found = {"opacity_logits": d_opacities * opacities * (1 - opacities), "dc": d_dc, "rest": d_rest}
    result = {}
    for name, gradient in found.items():
        result[name] = np.zeros_like(getattr(splats, name))
        result[name][seen] = gradient
    return result


class Adam:
    """One array and its optimizer (Kingma and Ba 2015, Algorithm 1), float32."""

    FIRST, SECOND = 0.9, 0.999  # decay of the moments
    EPSILON = 1e-15  # gradients of a mean over pixels are small

    def __init__(self, start: np.ndarray) -> None:
        self.value = start
        self.first = np.zeros_like(start)
        self.second = np.zeros_like(start)
        self.steps = 0

    def moved(self, gradient: np.ndarray, rate: float) -> np.ndarray:
        """The array after a step down the gradient; that before it is left alone."""
        self.steps += 1
        self.first += np.float32(1 - self.FIRST) * (gradient - self.first)
        self.second *= np.float32(self.SECOND)
        self.second += np.float32(1 - self.SECOND) * gradient * gradient
        slow = np.sqrt(self.second) / np.float32(math.sqrt(1 - self.SECOND**self.steps))
        step = np.float32(rate / (1 - self.FIRST**self.steps))
        self.value = self.value - step * self.first / (slow + np.float32(self.EPSILON))
        return self.value


def _stride(count: int) -> int:
    """A step through a list that comes by every entry: no common factor with its length, about 0.38 of it."""
    stride = max(1, round(0.382 * count))
    while math.gcd(stride, count) > 1:
        stride += 1
    return stride
