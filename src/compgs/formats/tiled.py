"""Scenes of many files: a folder with a .cgs file for each tile, and `manifest.json`, which says what they are.

docs/tiles.md has the layout. The manifest is small: what must be known of a tile to leave it on disk until a camera
sees it. It is checked as a whole by a checksum before any of it is believed, and each tile by its hash when it is read.
"""

import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgs.cameras import Camera
from compgs.codec.format import LARGEST_DILATION, SMALLEST_DILATION
from compgs.errors import CorruptSection, NotACompGSFile, TruncatedSection, UnsupportedVersion

SUFFIX = ".tiles"  # of the folder's name
MANIFEST = "manifest.json"
KIND = "compgs tiles"
VERSION = 1
MOST_BYTES = 1 << 28  # of a manifest
MOST_TILES = 1 << 16
MOST_SPHERES = 1 << 10  # of a tile
MOST_LEVELS = 1 << 5  # of a tile
MOST_NUMBER = 1e30  # of any coordinate or radius: squares stay finite in double precision, sums in single
MOST_SIDE = 1 << 20  # pixels
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
BEGINNING = re.compile(rb'\s*\{\s*"format"\s*:\s*"compgs tiles"')
COPY = "copy the whole folder again"

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Core:
    """The part of the ground whose anchors a tile holds: [low, high), world units along the ground's two axes.

    Infinite where nothing lies beyond.
    """

    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True)
class Level:
    """A beginning of a tile's file that is a scene."""

    bytes: int
    anchors: int  # that are in it
    coupled_primitives: int  # that are in it


@dataclass(frozen=True, eq=False)
class TileEntry:
    """A tile, as the manifest has it. Its file is `<name>.cgs`, beside the manifest."""

    name: str
    bytes: int  # of the file
    sha256: str  # of the file
    anchors: int
    coupled_primitives: int
    memory: int  # bytes of the tile's arrays once it is open
    world_offset: Vector  # world units, float64
    spheres: (
        np.ndarray
    )  # [G, 4] float64: centre, counted from the manifest's world offset, and radius; world units
    core: Core | None = None  # None: of a tile that was not cut
    levels: tuple[Level, ...] = ()  # from coarse to fine, without the whole file

    @property
    def file(self) -> str:
        return f"{self.name}.cgs"


@dataclass(frozen=True)
class GroundAxes:
    """Where cores are measured: a point of the world and two directions of the ground, unit vectors."""

    origin: Vector
    right: Vector
    forward: Vector


@dataclass(frozen=True, eq=False)
class Manifest:
    """What there is to know of a scene before any tile is read."""

    tiles: tuple[TileEntry, ...]  # in the order in which they are drawn
    world_offset: Vector  # world units, float64: of the frame in which all tiles are drawn
    background: Vector  # RGB, 0 to 1
    up: Vector  # direction of the sky
    viewpoints: tuple[Camera, ...] = ()  # of the world, the best first
    ground: GroundAxes | None = None
    angular_dilation: float | None = None  # of what is drawn (`RasterSettings`)

    def encoded(self) -> bytes:
        """The content of the file: JSON."""
        content = {
            "world_offset": list(self.world_offset),
            "background": list(self.background),
            "angular_dilation": self.angular_dilation,
            "up": list(self.up),
            "ground": None if self.ground is None else ground_entry(self.ground),
            "viewpoints": [camera_entry(camera) for camera in self.viewpoints],
            "tiles": [_tile_entry(tile) for tile in self.tiles],
        }
        head = {"format": KIND, "version": VERSION, "checksum": _checksum(content)}
        return (json.dumps(head | content, separators=(",", ":"), allow_nan=False) + "\n").encode()


def begins(head: bytes) -> bool:
    """Whether a file begins as a manifest does."""
    return BEGINNING.match(head) is not None


def read_manifest(path: Path) -> Manifest:
    """Raises NotACompGSFile, UnsupportedVersion, CorruptSection."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise CorruptSection(f"{path}: expected a manifest of at most {MOST_BYTES} bytes; {COPY}")
        data = path.read_bytes()
    except OSError as error:
        raise NotACompGSFile(f"{path}: cannot be read ({error.strerror})") from error
    if not begins(data):
        raise NotACompGSFile(f"{path}: is not a manifest of tiles")
    try:
        content = json.loads(data.decode("utf-8"))
        if content["version"] != VERSION:
            raise UnsupportedVersion(
                f"{path}: manifest of version {content['version']!r}, known here is {VERSION}; use a newer compgs"
            )
        rest = {
            name: value for name, value in content.items() if name not in ("format", "version", "checksum")
        }
        if content.get("checksum") != _checksum(rest):
            raise CorruptSection(f"{path}: the manifest's checksum does not match its content; {COPY}")
        return _manifest(rest)
    except (
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        IndexError,
        RecursionError,
        OverflowError,
    ) as error:
        raise CorruptSection(f"{path}: the manifest is damaged ({error!s:.200}); {COPY}") from error


def check(path: Path) -> None:
    """Raises BitstreamError unless manifest and files are whole, as far as can be told without reading the files."""
    for tile in read_manifest(path).tiles:
        file = path.parent / tile.file
        if not file.is_file():
            raise NotACompGSFile(f"{path}: tile {tile.name}: there is no {file}; {COPY}")
        found = file.stat().st_size
        if found != tile.bytes:
            raise TruncatedSection(
                f"{path}: tile {tile.name}: {tile.file} has {found} bytes, the manifest promises {tile.bytes}; {COPY}"
            )


def tile_bytes(folder: Path, tile: TileEntry) -> bytes:
    """The content of a tile's file. Raises NotACompGSFile, and CorruptSection if it is not the promised one."""
    file = folder / tile.file
    try:
        data = file.read_bytes()
    except OSError as error:
        raise NotACompGSFile(f"{file}: cannot be read ({error.strerror}); {COPY}") from error
    if len(data) != tile.bytes or hashlib.sha256(data).hexdigest() != tile.sha256:
        raise CorruptSection(f"{file}: is not the file that {MANIFEST} promises; {COPY}")
    return data


def component_bytes(path: Path) -> dict[str, int]:
    """Bytes of each component of all tiles together, and of the manifest. Raises BitstreamError."""
    from compgs.codec.format import named
    from compgs.codec.reader import file_info

    manifest = read_manifest(path)
    total: dict[str, int] = {}
    for tile in manifest.tiles:
        data = tile_bytes(path.parent, tile)
        with named(path.parent / tile.file):
            sections = file_info(data).sections
        for section in sections:
            total[section.name] = total.get(section.name, 0) + section.bytes
    return {**total, "manifest": path.stat().st_size}


# to and from JSON --------------------------------------------------------------------------------------------------


def _checksum(content: dict[str, Any]) -> str:
    """SHA-256 of the content in a form that does not depend on spaces, nor on the order of names."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _tile_entry(tile: TileEntry) -> dict[str, Any]:
    return {
        "name": tile.name,
        "bytes": tile.bytes,
        "sha256": tile.sha256,
        "anchors": tile.anchors,
        "coupled_primitives": tile.coupled_primitives,
        "memory": tile.memory,
        "world_offset": list(tile.world_offset),
        "core": None if tile.core is None else core_entry(tile.core),
        "levels": [[level.bytes, level.anchors, level.coupled_primitives] for level in tile.levels],
        "spheres": [[shortened(value, 7) for value in row] for row in tile.spheres.tolist()],
    }


def core_entry(core: Core) -> dict[str, Any]:
    """JSON has no infinity: null takes its place."""
    return {
        name: [edge if math.isfinite(edge) else None for edge in edges] for name, edges in vars(core).items()
    }


def core_from_entry(entry: dict[str, Any]) -> Core:
    """Inverse of `core_entry`. Raises ValueError, KeyError, TypeError."""

    def edges(values: Sequence[Any], open_edge: float) -> tuple[float, float]:
        first, second = (open_edge if value is None else _number(value) for value in values)
        return first, second

    core = Core(edges(entry["low"], -math.inf), edges(entry["high"], math.inf))
    if any(low >= high for low, high in zip(core.low, core.high, strict=True)):
        raise ValueError(f"a core from {core.low} to {core.high}")
    return core


def ground_entry(ground: GroundAxes) -> dict[str, Any]:
    """Return the ground as JSON has it."""
    return {name: list(value) for name, value in vars(ground).items()}


def ground_from_entry(entry: dict[str, Any]) -> GroundAxes:
    """Inverse of `ground_entry`. Raises ValueError, KeyError, TypeError."""
    return GroundAxes(*(_vector(entry[name]) for name in ("origin", "right", "forward")))


def camera_entry(camera: Camera) -> dict[str, Any]:
    """Digits for a thousandth of the rounding that files of tiles have for their own viewpoints."""
    pose = np.asarray(camera.world_to_camera, np.float64).tolist()
    lens = {name: shortened(getattr(camera, name), 9) for name in ("fx", "fy", "cx", "cy")}
    sides = {"width": camera.width, "height": camera.height}
    return {"world_to_camera": [[shortened(value, 12) for value in row] for row in pose], **lens, **sides}


def shortened(value: float, digits: int) -> float:
    """The nearest number of so many digits: manifests are text, and longer numbers would say nothing more."""
    return float(f"{value:.{digits}g}")


def _manifest(content: dict[str, Any]) -> Manifest:
    tiles = _list(content["tiles"], 1, MOST_TILES, _tile)
    names = [tile.name for tile in tiles]
    if len(set(names)) != len(names):
        raise ValueError("two tiles have one name")
    ground = content["ground"]
    return Manifest(
        tiles=tiles,
        world_offset=_vector(content["world_offset"]),
        background=_vector(content["background"]),
        up=_vector(content["up"]),
        viewpoints=_list(content["viewpoints"], 0, MOST_TILES, _camera),
        ground=None if ground is None else ground_from_entry(ground),
        angular_dilation=_angular_dilation(content.get("angular_dilation")),
    )


def _angular_dilation(value: Any) -> float | None:
    """None in manifests from before tiles had one."""
    if value is None:
        return None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not SMALLEST_DILATION <= value <= LARGEST_DILATION:
        raise ValueError(f"angular_dilation is {value!r:.80}")
    return float(value)


def _tile(entry: dict[str, Any]) -> TileEntry:
    name = entry["name"]
    if not isinstance(name, str) or not NAME.fullmatch(name):  # it becomes the name of a file
        raise ValueError(f"a tile named {name!r:.80}")
    spheres = np.array(_list(entry["spheres"], 1, MOST_SPHERES, _sphere), np.float64)
    sha256 = entry["sha256"]
    if not isinstance(sha256, str) or not re.fullmatch("[0-9a-f]{64}", sha256):
        raise ValueError(f"tile {name}: its hash is {sha256!r:.80}")
    core = entry["core"]
    whole = Level(*(_count(entry[name]) for name in ("bytes", "anchors", "coupled_primitives")))
    return TileEntry(
        name=name,
        bytes=whole.bytes,
        sha256=sha256,
        anchors=whole.anchors,
        coupled_primitives=whole.coupled_primitives,
        memory=_count(entry["memory"]),
        world_offset=_vector(entry["world_offset"]),
        spheres=spheres,
        core=None if core is None else core_from_entry(core),
        levels=_levels(entry.get("levels", []), whole),
    )


def _levels(values: Any, whole: Level) -> tuple[Level, ...]:
    """None in manifests from before tiles had them. Each is more than the one before, and the whole more than all."""
    levels = _list(values, 0, MOST_LEVELS, _level)
    for one, finer in itertools.pairwise((*levels, whole)):
        if not (
            one.bytes < finer.bytes
            and one.anchors < finer.anchors
            and one.coupled_primitives <= finer.coupled_primitives
        ):
            raise ValueError(f"a level of {one} before one of {finer}")
    return levels


def _level(values: Any) -> Level:
    size, anchors, coupled = values
    return Level(_count(size), _count(anchors), _count(coupled, least=0))


def _sphere(values: Any) -> tuple[float, ...]:
    x, y, z, radius = map(_number, values)
    if radius < 0:
        raise ValueError(f"a radius of {radius}")
    return x, y, z, radius


def _camera(entry: dict[str, Any]) -> Camera:
    pose = np.array([[_number(value) for value in row] for row in entry["world_to_camera"]], np.float64)
    width, height = entry["width"], entry["height"]
    lens = [_number(entry[name]) for name in ("fx", "fy", "cx", "cy")]
    sound = pose.shape == (4, 4) and lens[0] > 0 and lens[1] > 0
    if not sound or not all(1 <= _count(side) <= MOST_SIDE for side in (width, height)):
        raise ValueError(f"a viewpoint of {width} x {height} pixels, lens {lens}")
    return Camera(pose, lens[0], lens[1], lens[2], lens[3], width, height)


def _vector(values: Any) -> Vector:
    x, y, z = map(_number, values)
    return x, y, z


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= MOST_NUMBER:
        raise ValueError(f"expected a number, found {value!r:.80}")
    return float(value)


def _count(value: Any, least: int = 1) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 1 << 48:
        raise ValueError(f"expected a count, found {value!r:.80}")
    return value


def _list(values: Any, fewest: int, most: int, read: Callable[[Any], Any]) -> tuple[Any, ...]:
    if not isinstance(values, list) or not fewest <= len(values) <= most:
        found = len(values) if isinstance(values, list) else type(values).__name__
        raise ValueError(f"expected a list of {fewest} to {most}, found {found}")
    return tuple(map(read, values))
