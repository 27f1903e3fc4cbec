"""A scene of tiles that are opened when a camera sees them, and closed when memory is wanted for others.

    camera ──spheres of the manifest──► tiles in view ──one after the other──► Gaussians ──► one picture

The picture is the same however many tiles are open: tiles are drawn in the manifest's order, and what is left out of it
cannot reach a pixel.
"""

import os
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compgs.cameras import Camera
from compgs.codec.decoder import decode_bytes
from compgs.devices import CPU, check_device, drawn
from compgs.errors import ConfigError, CorruptSection
from compgs.formats.tile_detail import levels_with_whole, wanted_levels
from compgs.formats.tiled import COPY, Manifest, Vector, check, read_manifest, tile_bytes
from compgs.gaussians import Gaussians
from compgs.model.hybrid_model import HybridModel
from compgs.render.contributions import Blended
from compgs.render.rasterize import blended, rasterize_parts
from compgs.render.render_model import DrawsItself
from compgs.render.result import RasterResult
from compgs.render.settings import DEFAULT_SETTINGS, RasterSettings
from compgs.render.visibility import visible_mask

if TYPE_CHECKING:
    from compgs.devices import Device

ASKED_BY = "COMPGS_TILES_MEMORY"  # environment variable: bytes of open tiles
SHARE = 0.5  # of the machine's memory that open tiles may take where nobody says otherwise
UNKNOWN = 4 << 30  # bytes of memory where the system does not say


def tile_memory() -> int:
    """Bytes that open tiles may take: what `COMPGS_TILES_MEMORY` says, else half of the machine's memory.

    Raises ConfigError for what is no number of bytes.
    """
    asked = os.environ.get(ASKED_BY)
    if asked is None:
        try:
            whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        except (AttributeError, OSError, ValueError):
            whole = UNKNOWN
        return int(SHARE * whole)
    if not asked.isdecimal() or int(asked) < 1:
        raise ConfigError(f"{ASKED_BY}={asked}: expected a number of bytes, such as 2000000000")
    return int(asked)


def resident_bytes(model: HybridModel) -> int:
    """Count the bytes of a tile's arrays once it has been looked at: what is stored, and the geometry that is predicted
    of it.
    """
    p = model.primitives
    anchor = (
        p.positions.itemsize * 3 + p.log_scales.itemsize * 6 + p.references.itemsize * p.references.shape[1]
    )
    coupled = p.residuals.itemsize * p.residuals.shape[1] + p.anchor_index.itemsize
    first, radius, geometry = 8, 4, 4 * (3 + 3 + 4)
    return len(p) * (anchor + first + radius) + len(p.residuals) * (coupled + geometry)


class TileCache:
    """Open tiles, of at most so many bytes; but always the one that is asked for."""

    def __init__(self, read: Callable[[int], HybridModel], expected: Sequence[int], most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.bytes = 0  # of the open tiles
        self.most_open = 0  # bytes, so far
        self.reads = 0  # tiles opened so far
        self._read = read
        self._expected = expected  # bytes of each tile, before it is opened
        self._open: OrderedDict[int, tuple[HybridModel, int]] = OrderedDict()  # the longest unused first

    def __contains__(self, index: int) -> bool:
        return index in self._open

    def get(self, index: int, wanted: Collection[int] = ()) -> HybridModel:
        """The tile; `wanted`: all tiles of the same picture, of which those that are still to come stay if they can.

        What is not wanted is closed first, the longest unused before others. Then, of what is, the one that was used
        last: a picture with more tiles than fit finds most of them open the next time, where closing the longest
        unused would find none.
        """
        if index in self._open:
            self._open.move_to_end(index)
            return self._open[index][0]
        self._make_room(self._expected[index], wanted)
        model = self._read(index)
        size = resident_bytes(model)
        self._make_room(size, wanted)
        self._open[index] = model, size
        self.bytes += size
        self.most_open = max(self.most_open, self.bytes)
        self.reads += 1
        return model

    def _make_room(self, size: int, wanted: Collection[int]) -> None:
        while self._open and self.bytes + size > self.most_bytes:
            victim = next((each for each in self._open if each not in wanted), next(reversed(self._open)))
            self.bytes -= self._open.pop(victim)[1]


def open_tiles(
    path: Path,
    device: "Device" = "cpu",
    *,
    memory: int | None = None,  # bytes of open tiles; None: `tile_memory`
    # of a picture: tiles are as fine as there is room for. None: all there are
    most_splats: int | None = None,
) -> "TiledScene":
    """A scene of tiles that are opened when a camera sees them. Raises BitstreamError, ConfigError."""
    check(path)
    return TiledScene.of(path.parent, read_manifest(path), str(device), memory, most_splats)


@dataclass(frozen=True, eq=False)
class Pieces:
    """What can be opened: every tile as a whole, under its own number, then their coarser levels."""

    places: Sequence[tuple[int, int]]  # the tile, and how many of its levels
    coupled: Sequence[int]  # coupled primitives
    memory: Sequence[int]  # bytes that are expected
    first: Sequence[int]  # of each tile: where its coarser levels are

    @classmethod
    def of(cls, manifest: Manifest) -> "Pieces":
        tiles = manifest.tiles
        places = [(index, len(tile.levels) + 1) for index, tile in enumerate(tiles)]
        first = []
        for index, tile in enumerate(tiles):
            first.append(len(places))
            places += [(index, number) for number in range(1, len(tile.levels) + 1)]
        coupled = [levels_with_whole(tiles[i])[number - 1].coupled_primitives for i, number in places]
        # A level takes its share of the tile, roughly; room is made once more when it is there.
        memory = [
            max(1, tiles[i].memory * count // tiles[i].coupled_primitives)
            for (i, _), count in zip(places, coupled, strict=True)
        ]
        return cls(places, coupled, memory, first)

    def of_tile(self, index: int, number: int) -> int:
        """The piece with so many levels of a tile."""
        return index if number == self.places[index][1] else self.first[index] + number - 1


@dataclass(frozen=True, eq=False)
class TiledScene:
    """A folder of tiles; the units of `bounds` are groups of neighbouring anchors of a tile (`Renderable`)."""

    manifest: Manifest
    device: str
    background: Vector  # RGB, 0 to 1
    cache: TileCache  # of `pieces`
    pieces: "Pieces"
    most_splats: int | None = (
        None  # of a picture; tiles are then as fine as there is room for. None: all there are
    )

    @classmethod
    def of(
        cls,
        folder: Path,
        manifest: Manifest,
        device: str = CPU,
        memory: int | None = None,
        most_splats: int | None = None,
    ) -> "TiledScene":
        """Raises ConfigError for a device or an amount of memory that cannot be."""
        check_device(device)
        pieces = Pieces.of(manifest)

        def read(piece: int) -> HybridModel:
            index, number = pieces.places[piece]
            tile = manifest.tiles[index]
            level = levels_with_whole(tile)[number - 1]
            data, is_whole = tile_bytes(folder, tile), number > len(tile.levels)
            model = decode_bytes(data[: level.bytes], folder / tile.file, device, prefix=not is_whole)
            promised = level.anchors, level.coupled_primitives, tile.world_offset
            if (model.anchors, model.coupled, model.world_offset) != promised:
                raise CorruptSection(
                    f"{folder / tile.file}: holds another scene than the manifest says; {COPY}"
                )
            return model

        most = tile_memory() if memory is None else memory
        cache = TileCache(read, pieces.memory, most)
        return cls(manifest, device, manifest.background, cache, pieces, most_splats)

    @property
    def world_offset(self) -> Vector:
        """World units, float64: origin of the frame in which all tiles are drawn."""
        return self.manifest.world_offset

    @property
    def angular_dilation(self) -> float | None:
        return self.manifest.angular_dilation

    @property
    def antialiased(self) -> bool:
        """Trained with plain dilation."""
        return False

    @property
    def up(self) -> Vector:
        """Direction of the sky."""
        return self.manifest.up

    @property
    def viewpoints(self) -> tuple[Camera, ...]:
        return self.manifest.viewpoints

    @property
    def counts(self) -> Mapping[str, int]:
        tiles = self.manifest.tiles
        return {
            "anchors": sum(tile.anchors for tile in tiles),
            "coupled_primitives": sum(tile.coupled_primitives for tile in tiles),
        }

    @property
    def most_gaussians(self) -> int:
        return self.counts["coupled_primitives"]

    def over(self, background: Vector) -> "TiledScene":
        """The same over another background; both share the open tiles."""
        return replace(self, background=background)

    @cached_property
    def _spheres(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres [G, 3], radii [G] float32, and the tile of each [G]."""
        tiles = self.manifest.tiles
        spheres = np.concatenate([tile.spheres for tile in tiles]).astype(np.float32)
        owner = np.repeat(np.arange(len(tiles)), [len(tile.spheres) for tile in tiles])
        return np.ascontiguousarray(spheres[:, :3]), np.ascontiguousarray(spheres[:, 3]), owner

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Spheres that hold all that is drawn of a group of anchors: centres [G, 3] and radii [G], world units."""
        return self._spheres[:2]

    def tiles_of(self, groups: np.ndarray) -> list[int]:
        """Tiles, ascending, of the groups of a mask [G] bool."""
        return np.unique(self._spheres[2][groups]).tolist()

    def gaussians(self, camera: Camera, visible: np.ndarray | None = None) -> Gaussians[np.ndarray]:
        """What a camera sees of the tiles to which the groups of a mask [G] belong, or of all."""
        return _joined(self.parts(camera, visible))

    def parts(self, camera: Camera, visible: np.ndarray | None = None) -> Iterator[Gaussians[np.ndarray]]:
        """The same, a part at a time; no two tiles need be open."""
        every = np.ones(len(self._spheres[0]), bool)
        return self._seen(self.tiles_of(every if visible is None else visible), camera, DEFAULT_SETTINGS)

    def draw(self, camera: Camera, settings: RasterSettings) -> RasterResult[np.ndarray]:
        """What a camera of the scene's frame sees; room is made for what the tiles in view hold, not for all."""
        tiles = self.tiles_of(visible_mask(*self.bounds, camera, settings))
        pieces = self._chosen(tiles, camera)
        parts = self._seen_of(pieces, camera, settings)
        if self.device != CPU:
            return drawn(_joined(parts), camera, settings, self.device)
        most = sum(self.pieces.coupled[piece] for piece in pieces)
        return rasterize_parts(parts, most, camera, settings)

    def blended(self, gaussians: Gaussians[np.ndarray], camera: Camera, settings: RasterSettings) -> Blended:
        """The image of Gaussians, which need not be the scene's own, with its gradients."""
        if self.device == CPU:
            return blended(gaussians, camera, settings)
        tile = self.cache.get(0)
        assert isinstance(tile, DrawsItself)
        return tile.blended(gaussians, camera, settings)

    def _chosen(self, tiles: Sequence[int], camera: Camera) -> list[int]:
        """Pieces to draw of tiles in view, in the order of the tiles."""
        if self.most_splats is None:
            return list(tiles)
        entries = [self.manifest.tiles[index] for index in tiles]
        wanted = wanted_levels(entries, camera, self.most_splats)
        return [self.pieces.of_tile(index, n) for index, n in zip(tiles, wanted, strict=True) if n]

    def _seen(
        self, tiles: Sequence[int], camera: Camera, settings: RasterSettings
    ) -> Iterator[Gaussians[np.ndarray]]:
        """What a camera sees of some tiles, in the scene's frame; one part at least."""
        return self._seen_of(self._chosen(tiles, camera), camera, settings)

    def _seen_of(
        self, pieces: Sequence[int], camera: Camera, settings: RasterSettings
    ) -> Iterator[Gaussians[np.ndarray]]:
        if not pieces:
            yield _nothing()
        wanted = frozenset(pieces)
        for piece in pieces:
            index = self.pieces.places[piece][0]
            shift = np.subtract(self.manifest.tiles[index].world_offset, self.world_offset)
            local = camera.moved(shift)
            model = self.cache.get(piece, wanted)
            for part in model.parts(local, visible_mask(*model.bounds, local, settings)):
                yield _moved(part, shift)
            del model  # or it would stay beside the next one, whatever the cache says


def _moved(gaussians: Gaussians[np.ndarray], shift: np.ndarray) -> Gaussians[np.ndarray]:
    """Move positions from a tile's frame, whose origin lies at `shift` [3], to the scene's."""
    if not shift.any():
        return gaussians
    return replace(gaussians, means=gaussians.means + shift.astype(np.float32))


def _joined(parts: Iterator[Gaussians[np.ndarray]]) -> Gaussians[np.ndarray]:
    rows = [tuple(vars(part).values()) for part in parts]
    return Gaussians(*(np.concatenate(arrays) for arrays in zip(*rows, strict=True)))


def _nothing() -> Gaussians[np.ndarray]:
    shapes = (0, 3), (0, 4), (0, 3), (0,), (0, 3)
    return Gaussians(*(np.empty(shape, np.float32) for shape in shapes))
