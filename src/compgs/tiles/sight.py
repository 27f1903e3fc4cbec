"""What each view shows of each tile, told by the points that are in its image.

Nothing hides anything here, so a street behind a house counts as seen; what is far away counts little, as it is small.
"""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.scene.sight import depths_in

# Of the median distance of what a camera sees: what is nearer counts as if it were so far. A few points right before
# the lens would else be the whole picture.
NEAREST = 0.25


def times_seen(cameras: Sequence[Camera], positions: np.ndarray) -> np.ndarray:
    """[P] int64: how many of the cameras have each of the positions [P, 3] in their image."""
    seen = np.zeros(len(positions), np.int64)
    for camera in cameras:
        seen += depths_in(camera, positions)[1]
    return seen


def shares_of_picture(
    cameras: Sequence[Camera],
    positions: np.ndarray,  # [P, 3] of the world
    members: np.ndarray,  # [P, T] bool: points of each tile; a point may be of several
) -> np.ndarray:  # [V, T] from 0 to 1
    """Return the share of a camera's image that is each tile's; a point counts as large as it appears.

    That is by the inverse square of its distance. A camera that sees no point shows nothing of any tile.
    """
    shares = np.zeros((len(cameras), members.shape[1]))
    for row, camera in zip(shares, cameras, strict=True):
        depth, inside = depths_in(camera, positions)
        if not inside.any():
            continue
        away = depth[inside]
        sizes = 1.0 / np.maximum(away, NEAREST * np.median(away)) ** 2
        row[:] = sizes @ members[inside] / sizes.sum()
    return shares
