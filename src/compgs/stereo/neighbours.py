"""Which photographs a photograph is compared with: those that see the same from a little aside."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.scene.sight import depths_in

NEIGHBOURS = 4
# Distance of two cameras over that of what they see: about 7 degrees. Nearer ones tell distances apart badly, those
# farther away see something else behind each edge.
BASELINE, LEAST_BASELINE = 0.12, 0.02
ASKED = 4_000  # of the sparse points: enough to know what two cameras have in common
FEWEST_SEEN = 20  # of these: with fewer in view, nothing is known of the distances there


@dataclass(frozen=True)
class Sight:
    """What a camera sees of the sparse points."""

    seen: np.ndarray  # [P] bool
    nearest: float  # world units along the axis: the first hundredth of the distances
    farthest: float  # of all but the farthest half of a hundredth
    middle: float  # the median


def sight_of(camera: Camera, points: np.ndarray) -> Sight | None:
    """What a camera sees of points [P, 3]; None if it is too little."""
    depths, seen = depths_in(camera, points)
    if seen.sum() < FEWEST_SEEN:
        return None
    nearest, middle, farthest = np.percentile(depths[seen], (1.0, 50.0, 99.5))
    return Sight(seen, float(nearest), float(farthest), float(middle))


def neighbours_of(number: int, cameras: Sequence[Camera], sights: Sequence[Sight | None]) -> list[int]:
    """The cameras to compare a camera with, the best first; none if it sees too little."""
    sight = sights[number]
    if sight is None:
        return []
    here, ahead = cameras[number].center, cameras[number].rotation[2]
    costs: list[tuple[float, int]] = []
    for other, (camera, theirs) in enumerate(zip(cameras, sights, strict=True)):
        baseline = float(np.linalg.norm(camera.center - here)) / sight.middle
        if other == number or theirs is None or baseline < LEAST_BASELINE:
            continue
        shared = (sight.seen & theirs.seen).sum() / sight.seen.sum()
        turned = 1.0 - float(camera.rotation[2] @ ahead)
        costs.append((abs(math.log(baseline / BASELINE)) + 2.0 * (1.0 - shared) + 2.0 * turned, other))
    return [other for _, other in sorted(costs)[:NEIGHBOURS]]


def asked_of(points: np.ndarray) -> np.ndarray:
    """Choose at most `ASKED` of points [P, 3], evenly spread over their order."""
    return points[:: max(1, math.ceil(len(points) / ASKED))].astype(np.float64)
