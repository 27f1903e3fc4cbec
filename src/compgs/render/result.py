"""What rasterization gives back."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class RasterResult:
    """One rendered view of M Gaussians."""

    image: Tensor  # [H, W, 3] RGB over the background; not clamped
    transmittance: Tensor  # [H, W] share of the background that shines through
    means2d: Tensor  # [M, 2] pixels, in the autograd graph; zeros where a Gaussian is not drawn
    visible: Tensor  # [M] bool: its box of pixels with alpha above the cutoff meets the image
