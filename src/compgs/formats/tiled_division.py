"""A .cgs file as a folder of tiles, without training: every primitive goes into the tile that its anchor stands in.

Latents, networks and places are those of the file, so tiles together show its picture. Each tile has the networks
again, and its octree anew: some kilobytes. What is gained is that viewers need only fetch what they look at.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from compgs.codec.content import COORDINATES, Group
from compgs.codec.decoder import from_latents
from compgs.codec.format import named
from compgs.codec.integer_network import IntegerNetwork
from compgs.codec.reader import read_latents
from compgs.codec.reduce import divided
from compgs.codec.writer import write_content
from compgs.errors import ConfigError
from compgs.formats.tiled_ground import contains, cores_of, grid_of, ground_across
from compgs.formats.tiled_writer import NewTile, write_tiles

# A tile for each so many: networks of 5 to 10 kB are then 3 % of a tile of Truck or less.
ANCHORS_A_TILE = 20_000


def divide_file(
    data: bytes,
    path: Path,  # that they are from, for messages
    folder: Path,
    grid: tuple[int, int] | None = None,
) -> int:
    """Write the scene in the bytes of a .cgs file as a folder of tiles; how many they are.

    `grid`: columns and rows; None: about square tiles of ANCHORS_A_TILE anchors. All tiles have about as many.
    Raises BitstreamError, ConfigError where the anchors cannot be cut so, OutputError.
    """
    with named(path):
        content, latents = read_latents(data)
    if any(map(_depends_on_place, content.groups)):
        raise ConfigError(
            f"{path}: its latents depend on where an anchor is in the whole scene, so no part of it can stand alone; "
            "send the file as it is, or train the capture in tiles (compgs tiles)"
        )
    drawn = np.asarray(content.mask.any(axis=1))
    if not drawn.any():
        raise ConfigError(f"{path}: has no primitives, so there is nothing to divide")
    positions = content.coordinates[drawn] * np.float64(content.voxel_size) + np.array(content.world_offset)
    ground = ground_across(from_latents(content, latents).up, positions)
    places = ground.places(positions)
    columns, rows = grid or grid_of(math.ceil(len(places) / ANCHORS_A_TILE), places)
    cores = cores_of(places, np.ones(len(places)), columns, rows)
    tile_of = np.empty(len(places), np.int64)
    for number, core in enumerate(cores.values()):
        tile_of[contains(core, places)] = number
    part_of = np.full(len(content.mask), -1)
    part_of[drawn] = tile_of

    def tiles() -> Iterator[NewTile]:
        for (name, core), part in zip(cores.items(), divided(content, part_of), strict=True):
            yield NewTile(name, write_content(part), core)

    write_tiles(folder, tiles(), ground)
    return len(cores)


def _depends_on_place(group: Group) -> bool:
    """Whether a group's means or scales follow the coordinates in the octree, which a part has anew. Files of this
    program with one mean a channel have a network that takes the coordinates, with weights of zero.
    """
    if not group.shape.sees_coordinates or not isinstance(group.prior, IntegerNetwork):
        return False
    return bool(group.prior.layers[0].weight[:, :COORDINATES].any())
