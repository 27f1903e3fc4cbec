"""How much of each tile a camera needs, with a cap on primitives: what would look coarsest becomes finer first.

The coarseness of a tile is the distance between neighbouring primitives in the picture, in pixels: the tile's size over
the root of their number, seen from where the camera is. Nothing but the manifest is needed for it. The web page has the
same rule (`web/src/tiles/detail.ts`).
"""

import math
from collections.abc import Sequence

import numpy as np

from compgs.cameras import Camera
from compgs.formats.tiled import Level, TileEntry

SHARP = 1.0  # pixels between primitives, below which more of them are not seen
NEAREST = 0.1  # of a tile's size: nearer to it, or within it, it does not become more urgent


def levels_with_whole(tile: TileEntry) -> tuple[Level, ...]:
    """List a tile's levels from coarse to fine; the last is the whole file."""
    return (*tile.levels, Level(tile.bytes, tile.anchors, tile.coupled_primitives))


def wanted_levels(
    tiles: Sequence[TileEntry],  # that are in view
    camera: Camera,  # of the manifest's frame
    most: int,  # primitives of all tiles together
) -> list[int]:
    """How many levels of each tile; 0: nothing of it."""
    steps = []
    for index, tile in enumerate(tiles):
        extent = camera.fx * _size(tile) / max(_distance(tile, camera), NEAREST * _size(tile))
        fewer = 1
        for number, level in enumerate(levels_with_whole(tile)):
            coarseness = extent / math.sqrt(max(1, fewer))
            if coarseness < SHARP:
                break
            steps.append((-coarseness, number, index, level.coupled_primitives - (fewer if number else 0)))
            fewer = level.coupled_primitives
    wanted = [0] * len(tiles)
    left = most
    for _, number, index, more in sorted(steps):
        # Of a tile that had no room nothing finer comes.
        if wanted[index] == number and more <= left:
            wanted[index], left = number + 1, left - more
    return wanted


def _size(tile: TileEntry) -> float:
    """Length over which the primitives are spread, world units."""
    radii = np.sort(tile.spheres[:, 3])
    # Of groups of neighbours, each on a piece of a surface; the sky among them must not count.
    return max(float(radii[len(radii) // 2]) * math.sqrt(len(radii)), 1e-30)


def _distance(tile: TileEntry, camera: Camera) -> float:
    offsets = tile.spheres[:, :3] - camera.center
    return float((np.linalg.norm(offsets, axis=1) - tile.spheres[:, 3]).min())
