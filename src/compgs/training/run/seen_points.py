"""Whether poses and points fit together: asked before the first step, as a run on others ends in an empty scene."""

import math

import numpy as np

from compgs.errors import TrainingError
from compgs.scene.sight import depths_in
from compgs.scene.views import Scene


def check_points_seen(scene: Scene, near_plane: float) -> None:
    """Raises TrainingError, with the remedy, if hardly any point is in the training views, or most are too near.

    `near_plane`: world units; what is nearer to a camera is not drawn.
    """
    positions = _sample(scene)
    seen = np.zeros(len(positions), dtype=bool)
    depths = []
    for view in scene.train_views:
        # With a tenth of its sides around the image: what is a little outside is drawn into it.
        depth, inside = depths_in(view.camera, positions, 0.1)
        seen |= inside
        depths.append(depth[inside])
    if seen.mean() < 0.01:  # of a reconstruction it is nearly all
        raise TrainingError(
            f"{scene.name}: {100 * seen.mean():.1f} % of the scene's points are in any training view; poses and points "
            "must be of one reconstruction, and poses have x to the right, y down and z forward (COLMAP)"
        )
    in_views = np.concatenate(depths)
    too_near = float((in_views < near_plane).mean())
    if too_near > 0.5:
        factor = 10.0 ** math.ceil(-math.log10(max(float(np.median(in_views)), 1e-30)))
        raise TrainingError(
            f"{scene.name}: {100 * too_near:.0f} % of what the training views see is nearer than {near_plane:g} world "
            f"units, and would not be drawn; scale camera positions and points up, {factor:g} times"
        )


def sightings(scene: Scene) -> float:
    """Training views that have a point in their image, the median over the points: what hides it is not asked."""
    positions = _sample(scene)
    counts = np.zeros(len(positions), dtype=np.int64)
    for view in scene.train_views:
        counts += depths_in(view.camera, positions)[1]
    return float(np.median(counts))


def _sample(scene: Scene) -> np.ndarray:
    """[P, 3] float64: some 10 000 points, spread over all of them; a share needs no more."""
    return scene.points.positions[:: max(1, len(scene.points) // 10_000)].astype(np.float64)
