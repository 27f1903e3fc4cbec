"""Where the anchors of a compressed scene start: on a voxel grid over the splats that are seen."""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.compressing.probing import probe
from compgs.formats.arrays import COLOR_OFFSET, Y0
from compgs.model.splats import SplatModel
from compgs.scene.views import Points

UNSEEN = 0.002  # of all weights in the pictures: the splats that have least, together, start no anchors
ROUNDS = 40  # of halving the range in which the voxel size is
WIDEST = 1e4  # times the smallest voxel size that is tried


def seen_weights(model: SplatModel, cameras: Sequence[Camera]) -> np.ndarray:
    """[M] float64: what each splat adds to the pictures of cameras, all of these together."""
    total = np.zeros(len(model.splats))
    for camera in cameras:
        looked = probe(model, camera)
        total[looked.splats] += looked.weights
    return total


def start_points(
    model: SplatModel,
    weights: np.ndarray,  # [M] of the splats
    anchors: int,  # about how many there should be, if no voxel size is given
    voxel_size: float | None = None,  # world units
) -> tuple[Points, float]:
    """One point for each anchor, with the color that is seen there, and the voxel size, in world units."""
    ascending = np.argsort(weights, kind="stable")
    idle = np.cumsum(weights[ascending]) <= UNSEEN * weights.sum()
    kept = np.ones(len(weights), dtype=bool)
    kept[ascending[idle]] = False
    offset = np.asarray(model.world_offset)
    means = model.splats.means.astype(np.float64)[kept]
    colors = np.clip(COLOR_OFFSET + Y0 * model.splats.dc[kept], 0.0, 1.0)
    size = voxel_size or voxel_size_for(means, anchors)
    _, cell = np.unique(np.round(means / size).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    total = np.bincount(cell, weights[kept])

    def averaged(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, weights[kept] * column) / total for column in values.T], axis=1)

    # The middle of the voxel, not the mean: rounding must find the same voxel again.
    corners = np.round(means / size)
    places = np.stack([np.bincount(cell, column) / np.bincount(cell) for column in corners.T], axis=1) * size
    return Points(places + offset, np.round(255 * averaged(colors)).astype(np.uint8)), size


def voxel_size_for(means: np.ndarray, anchors: int) -> float:
    """World units: the size with which about so many voxels have one of the means [M, 3] in them."""
    extent = float(np.ptp(means, axis=0).max()) or 1.0
    low, high = np.log(extent / WIDEST), np.log(2 * extent)
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        count = len(np.unique(np.round(means / np.exp(middle)).astype(np.int64), axis=0))
        low, high = (middle, high) if count > anchors else (low, middle)
    return float(np.exp(high))
