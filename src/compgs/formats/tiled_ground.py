"""The ground of a scene of tiles: the plane that is divided, with its longer direction first, and its cores.

Cores are a partition of the ground. The outer ones have no end: the sky and the far background are theirs.
"""

import itertools
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from compgs.errors import ConfigError
from compgs.formats.tiled import Core, GroundAxes, Vector, ground_from_entry

MOST_TILES = 1024  # of a grid; a million points each are a thousand million
INNER = 0.9  # share of the points, the nearest to the middle, that say how a scene lies: not the background
EDGES = 0.02  # share of a core's points on each side that do not say how long the side is: outer cores have no end


@dataclass(frozen=True)
class Ground(GroundAxes):
    """A point of the world, and two directions at right angles to the sky's. Places on it are world units."""

    @classmethod
    def from_entry(cls, entry: dict[str, Any]) -> "Ground":
        """Read the ground from a plan's JSON. Raises ValueError, KeyError, TypeError."""
        return cls(**vars(ground_from_entry(entry)))

    def places(self, positions: np.ndarray) -> np.ndarray:
        """[P, 2] float64 of positions [P, 3] of the world: what is above one another has one place."""
        away = np.asarray(positions, dtype=np.float64) - np.array(self.origin)
        return away @ np.array([self.right, self.forward]).T


def ground_across(sky: Vector, positions: np.ndarray) -> Ground:
    """The ground across the sky's direction; its first axis is the one along which points spread most.

    sky: a unit vector of the world, positions: [P, 3] of the world.
    """
    up = np.array(sky)
    middle = np.median(positions, axis=0)
    away = np.asarray(positions, dtype=np.float64) - middle
    flat = away - (away @ up)[:, None] * up
    distances = np.linalg.norm(flat, axis=1)
    inner = flat[distances <= np.quantile(distances, INNER)]
    # Smallest first: up, then across, then along.
    right = np.linalg.eigh(inner.T @ inner)[1][:, 2]
    right -= (right @ up) * up  # points that all stand above one another spread along `up` alone
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    right /= np.linalg.norm(right)
    if right[np.abs(right).argmax()] < 0:  # of two directions always the same one
        right = -right
    forward = np.cross(up, right)
    return Ground(*((float(x), float(y), float(z)) for x, y, z in (middle, right, forward)))


def parse_grid(text: str) -> tuple[int, int] | None:
    """Columns and rows of `4x2`; None of `auto`. Raises ConfigError."""
    if text == "auto":
        return None
    found = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text)
    if found is None or int(found[1]) * int(found[2]) > MOST_TILES:
        raise ConfigError(
            f"grid {text}: expected auto, or columns and rows such as 4x2, at most {MOST_TILES} tiles"
        )
    return int(found[1]), int(found[2])


def grid_of(count: int, places: np.ndarray) -> tuple[int, int]:
    """Columns and rows of at least `count` tiles (at most MOST_TILES) that are about square.

    places: [P, 2] on the ground.
    """
    count = min(MOST_TILES, max(1, count))
    width, height = sides(places)

    def unevenness(columns: int) -> float:
        rows = math.ceil(count / columns)
        return abs(math.log(width / columns * rows / height)) + math.log(columns * rows / count)

    columns = min(range(1, count + 1), key=unevenness)
    return columns, math.ceil(count / columns)


def contains(core: Core, places: np.ndarray) -> np.ndarray:
    """[P] bool: which of the places [P, 2] lie in [low, high)."""
    inside = (places >= core.low) & (places < core.high)
    return inside[:, 0] & inside[:, 1]


def cores_of(places: np.ndarray, weights: np.ndarray, columns: int, rows: int) -> dict[str, Core]:
    """Cores of equal weight by name, `column_row`, column by column; places: [P, 2], weights: [P].

    Raises ConfigError where there are too few places.
    """
    weights = weights if weights.any() else np.ones(len(places))
    cores = {}
    edges = [-math.inf, *cuts(places[:, 0], weights, columns), math.inf]
    for column in range(columns):
        mine = (places[:, 0] >= edges[column]) & (places[:, 0] < edges[column + 1])
        across = [-math.inf, *cuts(places[mine, 1], weights[mine], rows), math.inf]
        for row in range(rows):
            low, high = (edges[column], across[row]), (edges[column + 1], across[row + 1])
            cores[f"{column}_{row}"] = Core(low, high)
    return cores


def cuts(values: np.ndarray, weights: np.ndarray, parts: int) -> list[float]:
    """Where to cut values [P] into parts of equal weight: parts - 1 numbers between two values, ascending."""
    order = np.argsort(values, kind="stable")
    ordered, total = values[order], np.cumsum(weights[order])
    if len(total) == 0:
        raise ConfigError(f"grid: there are no points to cut into {parts} parts; use fewer tiles")
    at = np.searchsorted(total, total[-1] * np.arange(1, parts) / parts)
    following = np.minimum(at + 1, len(ordered) - 1)
    found = ((ordered[at] + ordered[following]) / 2).tolist()
    if any(second <= first for first, second in itertools.pairwise(found)):
        raise ConfigError(f"grid: {len(values)} points cannot be cut into {parts} parts; use fewer tiles")
    return found


def sides(places: np.ndarray) -> tuple[float, float]:
    """Lengths of the rectangle that holds all but a few of the places [P, 2]."""
    low, high = np.quantile(places, [EDGES, 1 - EDGES], axis=0)
    width, height = np.maximum(high - low, 1e-9)
    return float(width), float(height)
