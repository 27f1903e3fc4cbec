"""What rasterization gives back."""

from dataclasses import dataclass
from typing import Generic

from compgs.gaussians import Array


@dataclass(frozen=True, eq=False)
class RasterResult(Generic[Array]):
    """One rendered view of M Gaussians, in float32; of tensors, with gradients where they have them."""

    image: Array  # [H, W, 3] RGB over the background; not clamped
    transmittance: Array  # [H, W] share of the background that shines through
    means2d: Array  # [M, 2] pixels; zeros where a Gaussian is not drawn
    visible: Array  # [M] bool: its box of pixels with alpha above the cutoff meets the image
