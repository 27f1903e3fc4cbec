"""Where a scene of splats is, whatever floats around it: its middle, its size, and whether one stands inside of it."""

from dataclasses import dataclass

import numpy as np

from compgs.model.splats import SplatModel

LARGEST_AREA = 4.0  # medians: a larger splat, as of a sky, weighs no more
RADIUS_SHARE = 0.7  # of the weight, that lies within the radius
REACH_SHARE = 0.99  # of the weight, that lies within the reach


@dataclass(frozen=True, eq=False)
class Shape:
    """Means and weights of splats, in the local frame of their model, and what follows from them."""

    means: np.ndarray  # [M, 3] world units
    weights: np.ndarray  # [M] sum to 1: opacity x area
    middle: np.ndarray  # [3] median along each axis
    radius: float  # world units, from the middle: RADIUS_SHARE of the weight is within
    reach: float  # world units, likewise: nearly all of the weight is within
    core: np.ndarray  # [M] bool: splats within the reach
    cumulated: np.ndarray  # [M] sums of the weights up to a splat


def shape_of(model: SplatModel) -> Shape:
    """Quantiles by weight: neither few far splats nor many that are hardly there move them."""
    splats = model.splats
    means = splats.means.astype(np.float64)
    weights = splat_weights(model)
    middle = np.array([weighted_quantile(means[:, axis], weights, 0.5) for axis in range(3)])
    distances = np.linalg.norm(means - middle, axis=1)
    radius, reach = (weighted_quantile(distances, weights, share) for share in (RADIUS_SHARE, REACH_SHARE))
    # All in one place: as large as a splat is.
    least = float(np.exp(splats.log_scales.max()))
    return Shape(
        means, weights, middle, radius or least, reach or least, distances <= reach, np.cumsum(weights)
    )


def splat_weights(model: SplatModel) -> np.ndarray:
    """[M] float64, sum 1: opacity x area, the area of its two longer axes, at most LARGEST_AREA medians."""
    scales = np.sort(np.exp(model.splats.log_scales.astype(np.float64)), axis=1)
    areas = scales[:, 2] * scales[:, 1]
    areas = np.minimum(areas, LARGEST_AREA * np.median(areas))
    weights = areas * model.splats.opacities
    total = weights.sum()
    return weights / total if total > 0 else np.full(len(weights), 1 / len(weights))


def weighted_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """The value of [P] below which `share` of the weights [P] lies."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(below, share * below[-1])), len(values) - 1)])
