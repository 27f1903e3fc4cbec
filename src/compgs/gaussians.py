"""Gaussians: the primitives that are rendered, activated and in world units."""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

# Numpy arrays where a scene is looked at (`model`, `render`), torch tensors where it is trained (`tensors`).
Array = TypeVar("Array")


@dataclass(frozen=True)
class Gaussians(Generic[Array]):
    """M rendered primitives. Covariance = R(q) diag(scales)^2 R(q)^T; the color is already view dependent."""

    means: Array  # [M, 3] world units
    quaternions: Array  # [M, 4] w-x-y-z, need not be normalized, not zero
    scales: Array  # [M, 3] world units, standard deviations, > 0
    opacities: Array  # [M] in [0, 1]
    colors: Array  # [M, 3] display RGB, 0 to 1 (not clamped)

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,})"

    def __len__(self) -> int:
        means: Any = self.means
        return len(means)
