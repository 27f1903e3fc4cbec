"""From sparse points to anchors: the voxel grid, its size, and points for scenes that have none."""

from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.numerics.nearest import nearest
from compgs.scene.views import Points

MIN_POINTS = 100  # with fewer, structure from motion says too little of the scene to start from
MAX_STRAYS = 0.01  # share of the points that may be too far away for the grid
COLOR_NEIGHBOURS = 4  # points that an anchor's first color is made of: it may lie between two surfaces
COORDINATE_BITS = 21  # signed range of a coordinate: what the position coder represents


def voxel_grid(points: Points, voxel_size: float | None = None) -> tuple[np.ndarray, float]:
    """([N, 3] int32 unique coordinates in voxels, voxel size in world units): one voxel for all points in it.

    coordinate = round(position / voxel size) (CompGS Sec. 3.4). Without a voxel size it is the points' median
    distance to their nearest neighbour (`median_spacing`). Points beyond the range of coordinates are left
    out if they are few, as wrong triangulations are; else raises ConfigError.
    """
    positions = points.positions.astype(np.float64)
    size = median_spacing(positions) if voxel_size is None else float(voxel_size)
    if not (0 < size < float("inf")):
        raise ConfigError(f"voxel size {size}: expected above 0 and finite")
    scaled = np.round(positions / size)
    limit = (1 << (COORDINATE_BITS - 1)) - 1
    inside = (np.abs(scaled) <= limit).all(axis=1)
    if (~inside).sum() > MAX_STRAYS * len(positions):
        reach = float(np.abs(positions).max())
        raise ConfigError(
            f"voxel size {size:g}: the points reach {reach:g} world units from the origin, which is "
            f"{reach / size:.0f} voxels, but coordinates end at {limit}; use a voxel size of at least "
            f"{reach / limit:.3g}, or move the scene to the origin"
        )
    return np.unique(scaled[inside].astype(np.int32), axis=0), size


def colors_at(points: Points, positions: np.ndarray) -> np.ndarray:
    """[N, 3] display RGB in 0 to 1: at positions [N, 3], the mean of the nearest points' colors by inverse distance."""
    neighbours = min(COLOR_NEIGHBOURS, len(points))
    distances, found = nearest(points.positions, positions, neighbours)
    # A point that is met exactly counts much, not infinitely, also where all points are in one place.
    weights = 1.0 / np.maximum(distances + 1e-3 * distances.mean(), np.finfo(np.float32).tiny)
    weights /= weights.sum(1, keepdims=True)
    return (points.colors[found] / 255.0 * weights[..., None]).sum(1)


def neighbour_distance(positions: np.ndarray) -> np.ndarray:  # [P, 3] -> [P]
    """How far a point's neighbours are from it: the root of the mean square of three distances; 1 if it has none."""
    count = min(4, len(positions))
    if count < 2:
        return np.ones(len(positions))
    distances, _ = nearest(positions, positions, count)
    squares: np.ndarray = distances[:, 1:] ** 2
    return np.sqrt(squares.mean(1))


def median_spacing(positions: np.ndarray) -> float:  # positions: [P, 3] world units
    """The median distance of a point to its nearest neighbour; copies of a point count as one. World units.

    The median is not moved by outliers, far background or dense clusters of less than half of the points.
    """
    unique = np.unique(positions, axis=0)
    if len(unique) < 2:
        return 1.0
    distances, _ = nearest(unique, unique, 2)
    return float(np.median(distances[:, 1]))


def fallback_points(cameras: Sequence[Camera], count: int, seed: int = 0) -> Points:
    """Random gray points where the cameras look, for scenes whose sparse points are too few.

    Each point lies at a random pixel of a random camera. Its depth is drawn around the distance of the point
    that all cameras look at (closest to their axes) or, where they look apart, of the size of their path.
    """
    rng = np.random.default_rng(seed)
    centers = np.stack([camera.center for camera in cameras])
    forward = np.stack([camera.rotation[2] for camera in cameras])
    focus = _closest_to_axes(centers, forward)
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0
    depths = ((focus - centers) * forward).sum(axis=1)
    depths = np.where(depths > 0.1 * spread, depths, 2 * spread)
    chosen = rng.integers(len(cameras), size=count)
    pixels = rng.random((count, 2))
    # most between half and one and a half times the distance of the focus
    depth = depths[chosen] * rng.triangular(0.4, 1.0, 1.6, size=count)
    positions = np.empty((count, 3))
    for index, camera in enumerate(cameras):
        mine = chosen == index
        u, v = pixels[mine, 0] * camera.width, pixels[mine, 1] * camera.height
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
        positions[mine] = (rays * depth[mine, None] - camera.translation) @ camera.rotation
    return Points(positions, np.full((count, 3), 128, dtype=np.uint8))


def _closest_to_axes(centers: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[3] the point of least squared distance to the lines from centers [V, 3] along directions [V, 3]; where parallel
    axes leave it open, of all such points the one that is nearest to the centers' mean.
    """
    # projects onto the plane across the axis
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    middle = centers.mean(axis=0)
    offsets = across @ (centers - middle)[:, :, None]
    # lstsq gives the smallest of all solutions: from the middle, not from wherever the world has its origin
    return middle + np.linalg.lstsq(across.sum(axis=0), offsets.sum(axis=0)[:, 0], rcond=1e-6)[0]
