"""How much of an image each Gaussian is: the weights with which its color was blended."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from compgs.cameras import Camera
from compgs.gaussians import Gaussians
from compgs.render.rasterize import blended
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings


class Blended(Protocol):
    """An image of M Gaussians, and how it depends on their opacities and colors, on whichever device it was drawn."""

    @property
    def image(self) -> np.ndarray:
        """[H, W, 3] float32 RGB over the background; not clamped."""
        ...

    def gradients(self, d_image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradients by opacities [M] and colors [M, 3] of a number whose gradient by the image is [H, W, 3]
        float32.
        """
        ...


Blend = Callable[[Gaussians[np.ndarray], Camera, RasterSettings], Blended]


def contributions(
    gaussians: Gaussians[np.ndarray],  # M
    camera: Camera,
    settings: RasterSettings = DEFAULT_SETTINGS,
    blend: Blend = blended,
) -> np.ndarray:  # [M] pixels, float32
    """Transmittance x alpha of each Gaussian, summed over the image's pixels.

    A pixel is the sum of weight x color: the derivative of the summed red channel by a Gaussian's red is the sum of its
    weights. So every rasterizer that has gradients has contributions, and none needs another kernel.
    """
    drawn = blend(gaussians, camera, settings)
    d_image = np.zeros_like(drawn.image)
    d_image[..., 0] = 1
    return drawn.gradients(d_image)[1][:, 0]
