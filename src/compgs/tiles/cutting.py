"""A trained tile without its margins."""

from typing import Any

import numpy as np

from compgs.errors import TrainingError
from compgs.formats.tiled_ground import Ground, contains
from compgs.tiles.plan import Tile


def cut_to_core(model: Any, ground: Ground, tile: Tile) -> None:
    """Take from a `TrainedModel` the coupled primitives of anchors outside of the tile's core; no file has them then.

    Whether an anchor is inside is decided in double precision, in the world: no two tiles of a plan keep one place.
    Raises TrainingError if nothing is left.
    """
    positions = model.positions().detach().cpu().numpy().astype(np.float64) + np.array(model.world_offset)
    inside = contains(tile.core, ground.places(positions))
    model.mask &= model.mask.new_tensor(inside.tolist())[:, None]
    if not model.mask.any():
        raise TrainingError(
            f"tile {tile.name}: no anchor is left in its core after training; use fewer tiles, or more steps"
        )
