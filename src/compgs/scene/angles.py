"""How far views are from one another, as an angle: what of a scene one shows otherwise than another.

Two views of one thing from different places show it under an angle, that between the rays from the thing to the two
cameras. Two views from one place that look elsewhere show different things: the angle between their axes. The distance
of two views is the larger of the two angles; a turn about the axis is none.
"""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.scene.sight import depths_in

MOST_POINTS = 20_000  # by which the distance of what a view shows is found
LEAST_POINTS = 5  # in a view, for their median distance to say something


def angular_distances(
    cameras: Sequence[Camera],
    others: Sequence[Camera],
    points: np.ndarray,  # [P, 3] of the scene, world units
    extent: float,  # world units: how far away a view's subject is taken to be where no points tell
) -> np.ndarray:
    """[C, O] degrees, 0 to 180: from each camera, by the subject in the middle of its image, to each of the others."""
    step = max(1, len(points) // MOST_POINTS)
    seen = np.asarray(points, dtype=np.float64)[::step]
    centers = np.stack([other.center for other in others])
    axes = np.stack([other.rotation[2] for other in others])
    rows = []
    for camera in cameras:
        depths, inside = depths_in(camera, seen) if len(seen) else (np.zeros(0), np.zeros(0, dtype=bool))
        depth = float(np.median(depths[inside])) if inside.sum() >= LEAST_POINTS else extent
        subject = camera.center + depth * camera.rotation[2]
        around = _angles(centers - subject, camera.center - subject)
        rows.append(np.maximum(around, _angles(axes, camera.rotation[2])))
    return np.stack(rows)


def nearest_angles(
    cameras: Sequence[Camera], others: Sequence[Camera], points: np.ndarray, extent: float
) -> list[float | None]:
    """Degrees from each camera to the nearest of the others; None where there are none."""
    if not cameras or not others:
        return [None] * len(cameras)
    return angular_distances(cameras, others, points, extent).min(axis=1).tolist()


def _angles(directions: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """[O] degrees between directions [O, 3] and one [3]; of a length of zero: none."""
    across = np.linalg.norm(np.cross(directions, direction), axis=1)
    return np.degrees(np.arctan2(across, directions @ direction))
