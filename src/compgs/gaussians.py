"""Gaussians: the primitives that are rendered, activated and in world units."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """M rendered primitives. Covariance = R(q) diag(scales)^2 R(q)^T; the color is already view dependent."""

    means: Tensor  # [M, 3] world units
    quaternions: Tensor  # [M, 4] w-x-y-z, need not be normalized, not zero
    scales: Tensor  # [M, 3] world units, standard deviations, > 0
    opacities: Tensor  # [M] in [0, 1]
    colors: Tensor  # [M, 3] display RGB, 0 to 1 (not clamped)

    def __len__(self) -> int:
        return len(self.means)
