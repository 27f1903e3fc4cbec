"""A folder of tiles from .cgs files: each is looked at once, to know where it lies and what it takes."""

import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.codec.decoder import decode_bytes
from compgs.codec.reader import file_info
from compgs.errors import ConfigError, OutputError
from compgs.formats.tiled import (
    MANIFEST,
    MOST_NUMBER,
    NAME,
    Core,
    GroundAxes,
    Level,
    Manifest,
    TileEntry,
    Vector,
    camera_entry,
)
from compgs.formats.tiled_scene import resident_bytes
from compgs.model.hybrid_model import HybridModel
from compgs.outputs import write_bytes

# A tile's groups of anchors, each with a sphere: enough that what is behind the camera is not opened for a few anchors
# far away, few enough that a manifest of a thousand tiles is a megabyte or two.
MOST_GROUPS = 32
LEAST_IN_GROUP = 256  # anchors
SLACK = 1e-5  # of the lengths involved, by which spheres are larger: they are rounded on the way
FEWEST_VIEWPOINTS, MOST_VIEWPOINTS = 12, 64  # of a scene; one of each tile between these
ENDLESS = 1e-3 * MOST_NUMBER  # world units: the radius of what reaches everywhere


@dataclass(frozen=True, eq=False)
class NewTile:
    """A tile to be written."""

    name: str
    data: bytes  # of a .cgs file
    core: Core | None = None


def write_tiles(folder: Path, tiles: Iterable[NewTile], ground: GroundAxes | None = None) -> Path:
    """Write a folder of tiles; the path of its manifest. Tiles are taken one at a time.

    The manifest is written last, so that a folder with one is whole; while tiles are replaced there is none. Files of
    tiles that are not among the new ones go. All tiles are shown over the first one's background and with its dilation.
    Raises BitstreamError for what is no .cgs file, ConfigError for names that no two tiles may have, OutputError.
    """
    manifest = folder / MANIFEST
    _remove([manifest])
    entries: list[TileEntry] = []
    kept: list[_Kept] = []
    for tile in tiles:
        if not NAME.fullmatch(tile.name) or tile.name in [entry.name for entry in entries]:
            raise ConfigError(
                f"tile {tile.name!r}: expected a name of letters and digits that no other tile has"
            )
        model = decode_bytes(tile.data, folder / f"{tile.name}.cgs")
        write_bytes(folder / f"{tile.name}.cgs", tile.data)
        entries.append(_entry(tile, model))
        kept.append(_Kept(model.background, model.up, model.viewpoints, model.angular_dilation))
    if not entries:
        raise ConfigError(f"{folder}: there are no tiles to write")
    offset = common_offset([entry.world_offset for entry in entries])
    written = Manifest(
        tiles=tuple(_counted_from(offset, entry) for entry in entries),
        world_offset=offset,
        background=kept[0].background,
        up=_mean_direction([each.up for each in kept]),
        viewpoints=_in_turns([each.viewpoints for each in kept]),
        ground=ground,
        angular_dilation=kept[0].angular_dilation,
    )
    names = {entry.file for entry in entries}
    _remove([file for file in folder.glob("*.cgs") if file.name not in names])
    write_bytes(manifest, written.encoded())
    return manifest


@dataclass(frozen=True, eq=False)
class _Kept:
    """What the manifest needs of a tile that is closed again."""

    background: Vector
    up: Vector
    viewpoints: tuple[Camera, ...]
    angular_dilation: float | None


def common_offset(offsets: Sequence[Vector]) -> Vector:
    """Return the offset of the frame in which tiles of these offsets are drawn: theirs if it is one, else their mean in
    whole units.
    """
    if len(set(offsets)) == 1:
        return offsets[0]
    x, y, z = (float(round(value)) for value in np.mean(offsets, axis=0))
    return x, y, z


def _entry(tile: NewTile, model: HybridModel) -> TileEntry:
    """Return the entry of a tile, with spheres in its own frame."""
    return TileEntry(
        name=tile.name,
        bytes=len(tile.data),
        sha256=hashlib.sha256(tile.data).hexdigest(),
        anchors=model.anchors,
        coupled_primitives=model.coupled,
        memory=resident_bytes(model),
        world_offset=model.world_offset,
        spheres=spheres(*model.bounds),
        core=tile.core,
        levels=tuple(
            Level(part.bytes, part.anchors, part.coupled)
            for part in file_info(tile.data).ranges
            if 0 < part.anchors < model.anchors
        ),
    )


def _counted_from(offset: Vector, entry: TileEntry) -> TileEntry:
    """Spheres in the frame of the manifest, rounded there as they will be when they are used."""
    moved = entry.spheres.copy()
    moved[:, :3] = (entry.spheres[:, :3] + np.subtract(entry.world_offset, offset)).astype(np.float32)
    moved[:, 3] += SLACK * (np.abs(moved[:, :3]).max(1) + moved[:, 3])
    return TileEntry(**{**vars(entry), "spheres": moved})


def spheres(centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """[G, 4] float64 centre and radius of groups of neighbours, each of which holds the spheres of its members.

    centers: [N, 3], radii: [N] world units. What is not finite is of no size that could be said: its group is endless.
    """
    most = max(LEAST_IN_GROUP, math.ceil(len(centers) / MOST_GROUPS))
    places = centers.astype(np.float64)
    result = []
    for rows in _groups(places, most):
        low, high = places[rows].min(0), places[rows].max(0)
        middle = (low + high) / 2
        with np.errstate(invalid="ignore", over="ignore"):
            reach = float((np.linalg.norm(places[rows] - middle, axis=1) + radii[rows]).max())
        endless = not reach < ENDLESS
        result.append((*(np.zeros(3) if endless else middle), ENDLESS if endless else reach))
    return np.array(result, np.float64)


def _groups(places: np.ndarray, most: int) -> list[np.ndarray]:
    """Rows of [N, 3] in groups of at most `most`: halved across the longest side until they are."""
    waiting, done = [np.arange(len(places))], []
    while waiting:
        rows = waiting.pop()
        if len(rows) <= most:
            done.append(rows)
            continue
        axis = int(np.ptp(places[rows], axis=0).argmax())
        half = len(rows) // 2
        order = np.argpartition(places[rows, axis], half)
        waiting += [rows[order[:half]], rows[order[half:]]]
    return done


def _mean_direction(directions: Sequence[Vector]) -> Vector:
    """Unit vector; the first one where they point everywhere."""
    mean = np.mean(directions, axis=0)
    length = float(np.linalg.norm(mean))
    if not length > 1e-3:
        return directions[0]
    x, y, z = (mean / length).tolist()
    return x, y, z


def _in_turns(viewpoints: Sequence[tuple[Camera, ...]]) -> tuple[Camera, ...]:
    """The best of each tile, then the second of each, and so on. Tiles of one file have the same ones, which count
    once.
    """
    most = min(max(FEWEST_VIEWPOINTS, len(viewpoints)), MOST_VIEWPOINTS)
    rounds = (camera for each in zip_longest(*viewpoints) for camera in each if camera is not None)
    different = {json.dumps(camera_entry(camera)): camera for camera in rounds}
    return tuple(different.values())[:most]


def _remove(files: Iterable[Path]) -> None:
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{file}: cannot be replaced ({error.strerror})") from error
