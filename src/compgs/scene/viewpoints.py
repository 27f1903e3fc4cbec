"""The few cameras of a capture that stand for all of them, and where its sky is."""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.errors import ConfigError

# Length of a mean of unit vectors, below which they point everywhere and their mean nowhere.
NO_DIRECTION = 0.1


def choose_viewpoints(cameras: Sequence[Camera], count: int) -> list[int]:
    """Indices of `count` different cameras (all of them if there are fewer) that are far from one another.

    First the camera that is nearest to the mean of all, then always the one that is farthest from those chosen
    (Gonzalez 1985); of equals the first. Distance is that of the positions, in units of their spread, and of the
    viewing directions. Raises ConfigError if `count` or the number of cameras is less than one.
    """
    if count < 1 or len(cameras) < 1:
        raise ConfigError(f"{count} viewpoints of {len(cameras)} cameras: expected at least one of one")
    places = _places(cameras)
    chosen = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmin())]
    distance = np.full(len(places), np.inf)
    while len(chosen) < min(count, len(places)):
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
        distance[chosen[-1]] = -1.0  # not again, even where others stand in the same place
        chosen.append(int(distance.argmax()))
    return chosen


def _places(cameras: Sequence[Camera]) -> np.ndarray:
    """[V, 6]: position in units of the root mean square distance from the mean, and viewing direction."""
    centers = np.stack([camera.center for camera in cameras])
    offsets = centers - centers.mean(axis=0)
    spread = float(np.sqrt((offsets**2).sum(axis=1).mean()))
    # Beside rounding errors of the centers: cameras that only turn have no spread.
    offsets = offsets / spread if spread > 1e-12 * float(np.abs(centers).max()) else np.zeros_like(offsets)
    return np.concatenate([offsets, np.stack([camera.rotation[2] for camera in cameras])], axis=1)


def up_direction(cameras: Sequence[Camera]) -> tuple[float, float, float]:
    """Unit vector to the sky, in world axes: the mean of what is up in the cameras' images.

    Where that points nowhere the cameras have been turned about their axes, as above a landscape: up is then against
    the mean viewing direction. Where that points nowhere either it is -y, as COLMAP's worlds usually come out.
    """
    for direction in (
        -np.mean([camera.rotation[1] for camera in cameras], axis=0),  # camera axes: y is down, z forward
        -np.mean([camera.rotation[2] for camera in cameras], axis=0),
    ):
        length = float(np.linalg.norm(direction))
        if length > NO_DIRECTION:
            x, y, z = (direction / length).tolist()
            return x, y, z
    return 0.0, -1.0, 0.0
