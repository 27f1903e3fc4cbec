"""Camera: where a view was taken from, in the OpenCV convention (x right, y down, z forward)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """An undistorted pinhole camera. Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)."""

    world_to_camera: np.ndarray  # [4, 4] float64, rigid
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels from the left edge of the image
    cy: float  # pixels from the top edge of the image
    width: int  # pixels
    height: int  # pixels

    def __repr__(self) -> str:
        place = ", ".join(f"{x:.4g}" for x in self.center)
        return f"Camera({self.width} x {self.height} pixels, fx {self.fx:.5g}, at ({place}))"

    @property
    def rotation(self) -> np.ndarray:
        """[3, 3] world to camera."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> np.ndarray:
        """[3] world units, in camera axes."""
        return self.world_to_camera[:3, 3]

    @property
    def center(self) -> np.ndarray:
        """[3] position of the camera in world units."""
        return -self.rotation.T @ self.translation

    def moved(self, origin: Sequence[float] | np.ndarray) -> "Camera":
        """The same camera in a frame whose origin lies at `origin` [3] of this one, its axes parallel (float64).

        The camera itself where `origin` is zero, so that nothing that is kept for a camera is computed again.
        """
        if not np.any(origin):
            return self
        pose = np.array(self.world_to_camera, dtype=np.float64)
        # x_camera = R (x - origin) + (t + R origin): right also where R is a rotation only nearly.
        pose[:3, 3] += pose[:3, :3] @ np.asarray(origin, dtype=np.float64)
        return replace(self, world_to_camera=pose)

    def resized(self, width: int, height: int) -> "Camera":
        """The same view, sampled on another grid of pixels; the field of view is unchanged."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
        )
