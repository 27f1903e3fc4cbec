"""What a viewer shows: a file of any format, as fine as asked for, or a scene that is being trained."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from compgs.cameras import Camera
from compgs.evaluation.camera_path import whole
from compgs.formats import component_bytes, format_of, open_scene, scene_file, scene_name
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
    """A file, or a beginning of it. Raises BitstreamError, SplatFileError."""

    def __init__(
        self, path: Path, device: str, background: Vector | None = None, level: int | None = None
    ) -> None:
        path = self.path = scene_file(path)
        self.device = device
        self.whole = open_scene(path, device, background or (0.0, 0.0, 0.0), level)
        self.background = background or self.whole.background
        self.world_offset = self.whole.world_offset
        self.up: Vector = getattr(self.whole, "up", USUAL_UP)
        self.title = scene_name(path)
        self._prefixes = _prefixes(path)
        whole = size(sum(component_bytes(path).values()))
        everything = f"all of it: {whole}" if level is None else f"level {level}"
        self.levels = (*(words for _, words in self._prefixes), everything)
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
        from compgs.codec import decode

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


def _prefixes(path: Path) -> list[tuple[int, str]]:
    """Bytes of a file's beginnings that are scenes, and what to call them; without the whole file."""
    if format_of(path).name != "cgs":
        return []
    from compgs.codec.reader import file_info

    ranges = file_info(path.read_bytes()).ranges
    return [(part.bytes, f"{size(part.bytes)}: {part.anchors:,} anchors") for part in ranges[:-1]]


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
