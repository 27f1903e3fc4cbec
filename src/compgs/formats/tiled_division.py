"""A .cgs file as a folder of tiles, without training: every primitive goes into the tile that its anchor stands in.

Latents, networks and places are those of the file, so tiles together show its picture. Each tile has the networks
again, and its octree anew: some kilobytes. What is gained is that viewers need only fetch what they look at.
"""

import math
from pathlib import Path

import numpy as np

from compgs.codec.format import named
from compgs.codec.reader import read_latents
from compgs.codec.reduce import divided
from compgs.codec.writer import write_content
from compgs.errors import ConfigError
from compgs.formats.tiled_ground import contains, cores_of, grid_of, ground_across
from compgs.formats.tiled_writer import NewTile, write_tiles

# A tile for each so many: networks of 5 to 10 kB are then 3 % of a tile of Truck or less.
ANCHORS_A_TILE = 20_000
UP = (0.0, -1.0, 0.0)  # of a file that does not say it, as in most captures


def divide_file(
    data: bytes,
    path: Path,  # that they are from, for messages
    folder: Path,
    grid: tuple[int, int] | None = None,
) -> int:
    """Write the scene in the bytes of a .cgs file as a folder of tiles; how many they are.

    `grid`: columns and rows; None: about square tiles of ANCHORS_A_TILE anchors. All tiles have about as many.
    Raises BitstreamError, NotEncodable of it where no part of the scene can stand alone, ConfigError where the anchors
    cannot be cut so, OutputError.
    """
    with named(path):
        content, latents = read_latents(data)
    drawn = np.asarray(content.mask.any(axis=1))
    if not drawn.any():
        raise ConfigError(f"{path}: has no primitives, so there is nothing to divide")
    positions = content.coordinates[drawn] * np.float64(content.voxel_size) + np.array(content.world_offset)
    ground = ground_across(UP if content.viewpoints is None else content.viewpoints.up, positions)
    places = ground.places(positions)
    columns, rows = grid or grid_of(math.ceil(len(places) / ANCHORS_A_TILE), places)
    cores = cores_of(places, np.ones(len(places)), columns, rows)
    tile_of = np.empty(len(places), np.int64)
    for number, core in enumerate(cores.values()):
        tile_of[contains(core, places)] = number
    part_of = np.full(len(content.mask), -1)
    part_of[drawn] = tile_of

    with named(path):
        parts = list(divided(content, latents, part_of))  # what is refused is so before anything is replaced
    tiles = (
        NewTile(name, write_content(part), core)
        for (name, core), part in zip(cores.items(), parts, strict=True)
    )
    write_tiles(folder, tiles, ground)
    return len(cores)
