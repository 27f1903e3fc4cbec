"""Where a camera has positions in its image, as far as geometry alone can tell: nothing hides anything."""

import numpy as np

from compgs.cameras import Camera


def places_in(camera: Camera, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns and rows [P] in pixels, as fractions, of positions [P, 3] in a camera's image, and their distances
    [P] along its axis in world units. Places of what is not ahead of the camera mean nothing.
    """
    x, y, depth = (positions @ camera.rotation.T + camera.translation).T
    safe = np.where(depth > 0, depth, 1.0)
    return camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy, depth


def inside(camera: Camera, column: np.ndarray, row: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """[P] bool: which places in pixels are in a camera's image, or beside it by at most a `margin` of its sides."""
    across = (column > -margin * camera.width) & (column < (1 + margin) * camera.width)
    down = (row > -margin * camera.height) & (row < (1 + margin) * camera.height)
    return np.asarray(across & down)


def depths_in(camera: Camera, positions: np.ndarray, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Distances [P] of positions [P, 3] along the camera's axis, world units; [P] bool: which are in its image, or
    beside it by at most a `margin` of its sides.
    """
    column, row, depth = places_in(camera, positions)
    return depth, (depth > 0) & inside(camera, column, row, margin)
