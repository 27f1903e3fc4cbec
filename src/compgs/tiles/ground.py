"""The ground of a capture: the plane that is divided, with its longer direction first."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.formats.tiled import GroundAxes, ground_from_entry
from compgs.scene.viewpoints import up_direction

INNER = 0.9  # share of the points, the nearest to the middle, that say how the capture lies: not the far background


@dataclass(frozen=True)
class Ground(GroundAxes):
    """A point of the world, and two directions at right angles to the sky's. Places on it are world units."""

    @classmethod
    def from_entry(cls, entry: dict[str, Any]) -> "Ground":
        """Read the ground from a plan's JSON. Raises ValueError, KeyError, TypeError."""
        return cls(**vars(ground_from_entry(entry)))

    def places(self, positions: np.ndarray) -> np.ndarray:
        """[P, 2] float64 of positions [P, 3] of the world: what is above one another has one place."""
        away = np.asarray(positions, dtype=np.float64) - np.array(self.origin)
        return away @ np.array([self.right, self.forward]).T


def ground_of(cameras: Sequence[Camera], positions: np.ndarray) -> Ground:
    """Across the direction that the cameras have above them; its first axis is the one along which points spread most.

    positions: [P, 3] of the world.
    """
    up = np.array(up_direction(cameras))
    middle = np.median(positions, axis=0)
    away = np.asarray(positions, dtype=np.float64) - middle
    flat = away - (away @ up)[:, None] * up
    distances = np.linalg.norm(flat, axis=1)
    inner = flat[distances <= np.quantile(distances, INNER)]
    # Smallest first: up, then across, then along.
    right = np.linalg.eigh(inner.T @ inner)[1][:, 2]
    right -= (right @ up) * up  # points that all stand above one another spread along `up` alone
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    right /= np.linalg.norm(right)
    if right[np.abs(right).argmax()] < 0:  # of two directions always the same one
        right = -right
    forward = np.cross(up, right)
    return Ground(*((float(x), float(y), float(z)) for x, y, z in (middle, right, forward)))
