"""A scene as streamed SOG (`lod-meta.json`): its own levels of detail, each baked to splats that look like all of it.

    file ──beginnings──► coarser scenes ──bake──► splats ──fit to pictures of the whole──► levels ──► parts in a folder

A .cgs file has its levels already: its beginnings are scenes. A scene of tiles is taken tile by tile, so that one tile
at a time is in memory. Files of splats have one level, of which a viewer loads what is near.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from compgs.codec.decoder import decode_bytes
from compgs.codec.format import MAGIC
from compgs.codec.reader import file_info
from compgs.formats import tiled
from compgs.formats.arrays import SplatArrays
from compgs.formats.sog_streamed_writer import write_levels
from compgs.model.hybrid_model import HybridModel

MOST_LEVELS = 4  # viewers change the level where the distance has tripled: four reach far
FEWER = 0.5  # splats of a level at most, as a share of those of the next finer one

# Splats of a beginning of a scene, fitted to pictures of the whole.
Bake = Callable[[HybridModel, HybridModel], SplatArrays]


def levels_of(data: bytes) -> list[int]:
    """Bytes of the beginnings of a .cgs file that become levels, from the finest, all of it, to the coarsest."""
    ranges = file_info(data).ranges
    chosen = [(len(data), ranges[-1].coupled)]
    for part in reversed(ranges[:-1]):
        if len(chosen) < MOST_LEVELS and 0 < part.coupled <= FEWER * chosen[-1][1]:
            chosen.append((part.bytes, part.coupled))
    return [size for size, _ in chosen]


def levels_in(source: Path) -> int:
    """How many levels are baked of a .cgs file, or of all tiles of a manifest; none of other files."""
    data = source.read_bytes()
    if tiled.begins(data):
        tiles = tiled.read_manifest(source).tiles
        return sum(len(levels_of(tiled.tile_bytes(source.parent, tile))) for tile in tiles)
    return len(levels_of(data)) if data.startswith(MAGIC) else 0


def export_file(source: Path, path: Path, device: str, bake: Bake) -> None:
    """Write the levels of a .cgs file. Raises BitstreamError, SplatFileError, OutputError."""
    data = source.read_bytes()
    most = len(levels_of(data))
    write_levels(path, most, iter([_baked(data, source, device, bake, most)]))


def export_tiles(source: Path, path: Path, device: str, bake: Bake) -> None:
    """The same of a manifest of tiles, in its frame."""
    manifest = tiled.read_manifest(source)
    contents = [tiled.tile_bytes(source.parent, tile) for tile in manifest.tiles]
    most = max(len(levels_of(data)) for data in contents)

    def places() -> Iterator[list[SplatArrays]]:
        for data, tile in zip(contents, manifest.tiles, strict=True):
            baked = _baked(data, source.parent / tile.file, device, bake, most)
            yield [_moved(each, manifest.world_offset) for each in baked]

    write_levels(path, most, places())


def _baked(data: bytes, file: Path, device: str, bake: Bake, most: int) -> list[SplatArrays]:
    """The levels of a file; the coarsest once more until there are `most`."""
    whole = decode_bytes(data, file, device)
    result = [bake(whole, whole)]
    for size in levels_of(data)[1:]:
        result.append(bake(decode_bytes(data[:size], file, device, prefix=True), whole))
    return result + result[-1:] * (most - len(result))


def _moved(splats: SplatArrays, offset: Sequence[float]) -> SplatArrays:
    """Move splats from their tile's frame to that of all."""
    shift = np.subtract(splats.world_offset, offset)
    x, y, z = offset
    return replace(splats, means=(splats.means + shift).astype(np.float32), world_offset=(x, y, z))
