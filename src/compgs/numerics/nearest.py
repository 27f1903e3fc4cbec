"""Nearest neighbours, by scipy's k-d tree: what a training starts from."""

import numpy as np

from compgs.extras import require


def nearest(
    points: np.ndarray,  # [P, 3]
    queries: np.ndarray,  # [N, 3]
    count: int,  # at most P
) -> tuple[np.ndarray, np.ndarray]:  # [N, count] each
    """Distances to the nearest points, ascending, and which they are. Raises MissingDependency without scipy."""
    require("train", "looking for nearest points")
    from scipy.spatial import cKDTree

    distances, found = cKDTree(points).query(queries, k=count)
    return distances.reshape(len(queries), count), found.reshape(len(queries), count)
