"""Which positions a camera has in its image, as far as geometry alone can tell: nothing hides anything."""

import numpy as np

from compgs.cameras import Camera


def depths_in(camera: Camera, positions: np.ndarray, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Distances [P] of positions [P, 3] along the camera's axis, world units; [P] bool: which are in its image, or
    beside it by at most a `margin` of its sides.
    """
    x, y, depth = (positions @ camera.rotation.T + camera.translation).T
    ahead = depth > 0
    safe = np.where(ahead, depth, 1.0)
    column, row = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    across = (column > -margin * camera.width) & (column < (1 + margin) * camera.width)
    down = (row > -margin * camera.height) & (row < (1 + margin) * camera.height)
    return depth, ahead & across & down
