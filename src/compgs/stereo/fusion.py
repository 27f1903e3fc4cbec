"""What several photographs agree on, and one point for each cell of it that looks equally large.

A pixel's place holds where two other photographs have found the same distance. Places are gathered in cells whose size
goes with the distance they were seen from, in powers of two: what is far is large in the world and small in the
picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgs.cameras import Camera
from compgs.numerics.nearest import nearest
from compgs.scene.sight import places_in
from compgs.scene.views import Points

ASKED = 10  # photographs that a pixel's place is looked up in, those taken nearest
AGREEING = 2  # of these: they must have found it, too
FEWEST = 3  # places in a cell: fewer are mistakes mostly
APART = 1.4  # cells: no point is added so near to one that there is; structure from motion knows it better


@dataclass(frozen=True)
class Depths:
    """Distances that were found in a photograph."""

    camera: Camera
    color: np.ndarray  # [H, W, 3] uint8
    inverse: np.ndarray  # [H, W] float32, 1 / world units along the axis; 0: not known
    tolerance: float  # of the inverse


@dataclass(frozen=True)
class Places:
    """Points of surfaces."""

    positions: np.ndarray  # [P, 3] float64, world units
    colors: np.ndarray  # [P, 3] uint8
    footprints: np.ndarray  # [P] float64, world units: what a pixel of the small photograph covers there


def agreed(depths: Sequence[Depths]) -> Places:
    """Places of all pixels that enough other photographs confirm."""
    centers = np.stack([found.camera.center for found in depths])
    parts = []
    for number, found in enumerate(depths):
        order = np.argsort(np.linalg.norm(centers - centers[number], axis=1), kind="stable")
        parts.append(_confirmed(found, [depths[i] for i in order if i != number][:ASKED]))
    return Places(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.colors for part in parts]),
        np.concatenate([part.footprints for part in parts]),
    )


def _confirmed(found: Depths, others: Sequence[Depths]) -> Places:
    camera = found.camera
    row, column = np.nonzero(found.inverse > 0)
    distance = 1.0 / found.inverse[row, column].astype(np.float64)
    local = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy], 1)
    local = np.concatenate([local, np.ones((len(local), 1))], 1) * distance[:, None]
    positions = (local - camera.translation) @ camera.rotation
    agreeing = np.zeros(len(positions), np.int64)
    for other in others:
        agreeing += _agrees(other, positions)
    kept = agreeing >= AGREEING
    footprints = distance[kept] / camera.fx
    return Places(positions[kept], found.color[row[kept], column[kept]], footprints)


def _agrees(other: Depths, positions: np.ndarray) -> np.ndarray:
    """[P] bool: whether a photograph has found the same distance where it shows positions [P, 3]."""
    camera = other.camera
    column, row, distance = places_in(camera, positions)
    column, row, ahead = np.floor(column), np.floor(row), distance > 0
    inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    theirs = other.inverse[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
    return inside & (theirs > 0) & (np.abs(theirs - 1.0 / np.where(ahead, distance, 1.0)) < other.tolerance)


def thinned(places: Places, pixels: float, known: np.ndarray) -> Points:
    """One point, the mean, of each cell of about so many pixels of the small photographs, away from `known` [P, 3].

    Cells are half as large up to as large: their sides are powers of two.
    """
    levels = np.floor(np.log2(places.footprints * pixels))
    sides = np.exp2(levels)
    keys = [np.floor(places.positions[:, axis] / sides).astype(np.int64) for axis in range(3)]
    keys.append(levels.astype(np.int64))
    cell, first = _numbered(keys)
    count = np.bincount(cell)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, column) for column in values.T], 1) / count[:, None]

    positions, colors = mean(places.positions), mean(places.colors)
    distances, _ = nearest(known, positions, 1)
    kept = (count >= FEWEST) & (distances.reshape(-1) > APART * np.exp2(keys[3][first]))
    return Points(positions[kept], np.round(colors[kept]).astype(np.uint8))


def _numbered(keys: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """[P] the number of each of the tuples that keys [P] of integers make, equal tuples having one, in ascending order;
    and [C] where each of the C different ones is.

    `np.unique` of rows has the same numbers, and takes half as much memory again and twice the time.
    """
    order = np.lexsort(keys[::-1])
    new = np.zeros(len(order), bool)  # of the ordered ones: whether it differs from the one before
    new[:1] = True
    for key in keys:
        ordered = key[order]
        new[1:] |= ordered[1:] != ordered[:-1]
    number = np.empty(len(order), np.int64)
    number[order] = np.cumsum(new) - 1
    return number, order[new]
