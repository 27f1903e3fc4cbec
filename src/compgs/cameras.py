"""Camera: where a view was taken from, in the OpenCV convention (x right, y down, z forward)."""

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
