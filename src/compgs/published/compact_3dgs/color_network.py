"""Color as a function of place and direction: a hash grid and a small network, in place of harmonics. Free of torch.

    place ──contract──► unit cube ──hash grid──► 32 features ─┐
    direction of view ──harmonics of degree 0 to 3──► 16 ─────┴──► 64 ──relu──► 64 ──relu──► 3: coefficients of degree 0

`tensors.py` has the same with gradients.
"""

from dataclasses import dataclass

import numpy as np

from compgs.model.spherical_harmonics import COLOR_OFFSET, harmonic_basis
from compgs.model.spherical_harmonics_kernels import Y0
from compgs.published.compact_3dgs.hash_grid import GridLayout, grid_features

DIRECTION_DEGREE = 3
DIRECTION_NUMBERS = 16
HIDDEN = 64
BLOCK = 1 << 15  # places at once


def network_shapes(features: int) -> tuple[tuple[int, int], ...]:
    """Return the shapes of the weights, inputs by outputs; there are no biases."""
    return (features + DIRECTION_NUMBERS, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, 3)


@dataclass(frozen=True, eq=False)
class ColorNetwork:
    """What a splat's color is made of, beside its place."""

    layout: GridLayout
    grid: np.ndarray  # [entries, F] float32
    weights: tuple[np.ndarray, ...]  # float32, `network_shapes`
    middle: np.ndarray  # [3] float32, world units: of the cube
    unit: float  # world units: radius of what is not contracted

    def colors(self, means: np.ndarray, center: np.ndarray) -> np.ndarray:
        """[M, 3] float32, display RGB, not below 0: of splats at means [M, 3], seen from a camera's center [3]."""
        found = np.empty((len(means), 3), np.float32)
        for start in range(0, len(means), BLOCK):
            some = slice(start, start + BLOCK)
            found[some] = self._colors(means[some], center.astype(np.float32))
        return found

    def _colors(self, means: np.ndarray, center: np.ndarray) -> np.ndarray:
        directions = means - center
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        with np.errstate(over="ignore", invalid="ignore"):  # a file may hold any weights
            places = contracted((means - self.middle) / np.float32(self.unit))
            hidden = np.concatenate(
                [
                    grid_features(places, self.grid, self.layout),
                    harmonic_basis(directions, DIRECTION_DEGREE).astype(np.float32),
                ],
                axis=1,
            )
            for weights in self.weights[:-1]:
                hidden = np.maximum(hidden @ weights, 0)
            dc = hidden @ self.weights[-1]
            return np.nan_to_num(np.maximum(np.float32(COLOR_OFFSET) + np.float32(Y0) * dc, 0))


def contracted(points: np.ndarray) -> np.ndarray:
    """[M, 3] in the unit cube (Barron et al., Mip-NeRF 360): the unit ball is its middle, all else lies around."""
    norms = np.linalg.norm(points, axis=1, keepdims=True)
    far = np.maximum(norms, 1)
    return np.clip((2 - 1 / far) * points / far * 0.25 + 0.5, 0, 1).astype(np.float32)
