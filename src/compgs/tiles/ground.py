"""The ground of a capture: across the direction that its cameras have above them."""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.formats.tiled_ground import Ground, ground_across
from compgs.scene.viewpoints import up_direction


def ground_of(cameras: Sequence[Camera], positions: np.ndarray) -> Ground:
    """Where the ground of a capture lies; positions: [P, 3] of the world."""
    return ground_across(up_direction(cameras), positions)
