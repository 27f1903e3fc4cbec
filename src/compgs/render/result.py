"""What rasterization gives back."""

from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from compgs.gaussians import Array
from compgs.pictures import png


@dataclass(frozen=True, eq=False)
class RasterResult(Generic[Array]):
    """One rendered view of M Gaussians, in float32; of tensors, with gradients where they have them."""

    image: Array  # [H, W, 3] RGB over the background; not clamped
    transmittance: Array  # [H, W] share of the background that shines through
    means2d: Array  # [M, 2] pixels; zeros where a Gaussian is not drawn
    visible: Array  # [M] bool: its box of pixels with alpha above the cutoff meets the image

    def __repr__(self) -> str:
        image: Any = self.image
        return f"RasterResult(image {image.shape[1]} x {image.shape[0]} pixels)"

    def _repr_png_(self) -> bytes:
        """The image, in a notebook."""
        image: Any = self.image
        return png(np.asarray(image.detach().cpu() if hasattr(image, "detach") else image))
