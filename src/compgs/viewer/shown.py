"""What a viewer shows: a file of any format, as fine as asked for, or a scene that is being trained."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from compgs.cameras import Camera
from compgs.codec import decode
from compgs.codec.reader import file_info
from compgs.evaluation.camera_path import whole
from compgs.formats import sog_streamed
from compgs.formats.tiled_scene import open_tiles
from compgs.opening import HEAD_BYTES, component_bytes, format_of, open_scene, scene_file, scene_name
from compgs.render import Renderable
from compgs.words import size

if TYPE_CHECKING:
    pass

Vector = tuple[float, float, float]
KEPT_LEVELS = 3  # decoded beginnings of a file that are kept beside the whole
USUAL_UP = (0.0, -1.0, 0.0)  # where files say nothing: as COLMAP's worlds usually come out


class Shown(Protocol):
    """A scene to look at. Cameras are of the world; `model` is called by the thread that renders."""

    @property
    def title(self) -> str: ...

    @property
    def levels(self) -> tuple[str, ...]:
        """What there is to choose from, from coarse to fine, in words; the last is everything."""
        ...

    @property
    def world_offset(self) -> Vector: ...

    @property
    def up(self) -> Vector:
        """Direction of the sky."""
        ...

    @property
    def background(self) -> Vector:
        """RGB, 0 to 1."""
        ...

    @property
    def cameras(self) -> tuple[tuple[str, Camera], ...]:
        """Names and cameras to look from, the best first; at least one."""
        ...

    @property
    def positions(self) -> np.ndarray:
        """[N, 3] of the local frame: where there is something, roughly."""
        ...

    def model(self, level: int, *, fresh: bool) -> Renderable:
        """`fresh`: as it is now, where it changes; else an earlier state will do."""
        ...


class FileShown:
    """A file, or a beginning of it. Raises BitstreamError, SplatFileError.

    `most`: primitives that a picture may have. Tiles are then as fine as there is room for; a .cgs file is its longest
    beginning that is not more, a lod-meta.json its finest level. Splats without levels are all shown.
    """

    def __init__(
        self,
        path: Path,
        device: str,
        background: Vector | None = None,
        level: int | None = None,
        most: int | None = None,
    ) -> None:
        path = self.path = scene_file(path)
        self.device = device
        prefixes, everything = _beginnings(path, most)
        if level is None and most is not None:
            level = _level_within(path, most)
        if format_of(path).name == "tiles":
            self.whole: Renderable = open_tiles(path, device, most_splats=most)
        elif everything is not None:
            self.whole = decode(path, device, prefix=everything)
        else:
            self.whole = open_scene(path, device, background or (0.0, 0.0, 0.0), level)
        self.background = background or self.whole.background
        self.world_offset = self.whole.world_offset
        self.up: Vector = getattr(self.whole, "up", USUAL_UP)
        self.title = scene_name(path)
        self._prefixes = prefixes
        self.levels = (*(words for _, words in prefixes), _all_of(path, level, everything))
        cameras = self.whole.viewpoints
        self.cameras = tuple((f"camera {i}", camera) for i, camera in enumerate(cameras)) or (
            ("circle", _beside(self.whole)),
        )
        self.positions = self.whole.bounds[0]

    def model(self, level: int, *, fresh: bool = True) -> Renderable:
        """Raises BitstreamError for a part that is damaged."""
        return self.whole if level == len(self._prefixes) else self._beginning(level)

    @functools.lru_cache(maxsize=KEPT_LEVELS)  # noqa: B019  # one file is shown as long as the process lives
    def _beginning(self, level: int) -> Renderable:
        return decode(self.path, self.device, prefix=self._prefixes[level][0])


class GrowingShown:
    """A scene that is being trained. `grown` says how it is made into something to render, now and until called again.

    The snapshot is taken by who renders: the thread that trains, between two steps.
    """

    levels = ("",)

    def __init__(
        self,
        title: str,
        cameras: tuple[tuple[str, Camera], ...],
        world_offset: Vector,
        up: Vector,
        background: Vector,
        positions: np.ndarray,  # [N, 3] of the local frame, of points of the scene
    ) -> None:
        self.title = title
        self.cameras = cameras
        self.world_offset = world_offset
        self.up = up
        self.background = background
        self.positions = positions
        self._step = -1
        self._taken = -1  # step of the snapshot
        self._snapshot: Renderable | None = None
        self._take: Callable[[], Renderable] | None = None

    def grown(self, step: int, take: Callable[[], Renderable]) -> None:
        self._step, self._take = step, take

    def model(self, level: int, *, fresh: bool) -> Renderable:
        if self._snapshot is None or (fresh and self._taken != self._step):
            assert self._take is not None, "jobs are done after the first `grown`"
            self._snapshot, self._taken = self._take(), self._step
        return self._snapshot


def _beginnings(path: Path, most: int | None) -> tuple[list[tuple[int, str]], int | None]:
    """Bytes of a file's beginnings that are coarser scenes, and what to call them; and of the finest one that has at
    most so many primitives, None if that is the whole file.
    """
    if format_of(path).name != "cgs":
        return [], None
    ranges = file_info(path.read_bytes()).ranges
    fitting = [part for part in ranges if most is None or part.coupled <= most] or [ranges[0]]
    words = [(part.bytes, f"{size(part.bytes)}: {part.anchors:,} anchors") for part in fitting[:-1]]
    return words, None if fitting[-1] is ranges[-1] else fitting[-1].bytes


def _level_within(path: Path, most: int) -> int | None:
    """The finest level of a lod-meta.json with at most so many splats, else its coarsest; None: the finest there is, or
    another file.
    """
    with open(path, "rb") as file:
        if not sog_streamed.begins(file.read(HEAD_BYTES)):
            return None
    counts = sog_streamed.read_meta(path).counts
    full = [level for level, count in enumerate(counts) if count]
    level = next((level for level in full if counts[level] <= most), full[-1] if full else 0)
    return level or None


def _all_of(path: Path, level: int | None, prefix: int | None) -> str:
    """What the finest choice is, in words."""
    if prefix is not None:
        return f"{size(prefix)}: as much as may be drawn"
    if level is not None:
        return f"level {level}"
    return f"all of it: {size(sum(component_bytes(path).values()))}"


def _beside(model: Renderable) -> Camera:
    """Return a camera of the world, for a file that keeps none."""
    ((_, camera),) = whole(model.bounds[0], frames=1, width=640, height=480)
    return camera.moved(-np.array(model.world_offset))


def radius(positions: np.ndarray) -> float:
    """Return the radius of three quarters of the positions [N, 3] around their median: the far background does not
    count.
    """
    middle = np.median(positions, axis=0)
    return max(float(np.quantile(np.linalg.norm(positions - middle, axis=1), 0.75)), 1e-9)


def focus(positions: np.ndarray, camera: Camera) -> float:
    """Distance from a camera (local frame) to what it looks at: the median depth of positions [N, 3] in the middle half
    of its image, else the distance to the median position.
    """
    inside = positions @ camera.rotation.T + camera.translation
    inside = inside[inside[:, 2] > 0]
    x = np.abs(camera.fx * inside[:, 0] / inside[:, 2]) < camera.width / 4
    y = np.abs(camera.fy * inside[:, 1] / inside[:, 2]) < camera.height / 4
    depths = inside[x & y, 2]
    if len(depths):
        return float(np.median(depths))
    return max(float(np.linalg.norm(np.median(positions, axis=0) - camera.center)), 1e-9)
