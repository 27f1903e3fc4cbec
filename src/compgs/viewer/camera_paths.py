"""A way through a scene that a visitor records: views to pass through, in order; kept as a camera file.

The file is that of `compgs.evaluation.camera_path`, so that `compgs render --path FILE` goes the same way, and
`--cameras FILE` shows its views.
"""

import io
import json
import math
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from compgs.cameras import Camera
from compgs.errors import MissingDependency, SceneError
from compgs.evaluation.camera_path import camera_entry, parse_cameras
from compgs.evaluation.measure import encode_png
from compgs.evaluation.tour import way_through
from compgs.evaluation.video import check_video, write_video

RECORD_SECONDS = 0.5  # between two views of a flight that is being recorded
MOST_VIEWS = 10_000  # of a path: hours of flying


class CameraPath:
    """The views of a path, cameras of the world."""

    def __init__(self, views: Sequence[Camera] = ()) -> None:
        self.views = list(views)
        self._recorded = -math.inf  # when a view was recorded last

    def add(self, camera: Camera) -> None:
        if len(self.views) < MOST_VIEWS:
            self.views.append(camera)

    def record(self, camera: Camera, now: float) -> bool:
        """Add a view of a flight if it is time for one (`now`: seconds), and the camera is not where it was."""
        if now - self._recorded < RECORD_SECONDS:
            return False
        last = self.views[-1] if self.views else None
        if last is not None and np.allclose(last.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-9):
            return False
        self.add(camera)
        self._recorded = now
        return True

    def remove_last(self) -> None:
        del self.views[-1:]

    def clear(self) -> None:
        self.views.clear()

    def frames(self, count: int, width: int, height: int) -> list[Camera]:
        """Cameras on the way through the views. Raises UnsupportedCamera for fewer than two views."""
        return way_through(self.views, frames=count, width=width, height=height)

    def content(self) -> bytes:
        """Return the content of a camera file."""
        entries = [camera_entry(camera, f"view {i}") for i, camera in enumerate(self.views)]
        return json.dumps(entries, indent=2).encode()

    @classmethod
    def of(cls, content: bytes, name: str) -> "CameraPath":
        """Inverse of `content`. Raises SceneError with the file's name in front."""
        cameras = [camera for _, camera in parse_cameras(content, name)]
        if len(cameras) > MOST_VIEWS:
            raise SceneError(f"{name}: {len(cameras):,} cameras; expected at most {MOST_VIEWS:,}")
        return cls(cameras)


def filmed(
    cameras: Sequence[Camera],
    draw: Callable[[Camera], np.ndarray],  # [H, W, 3] uint8
    stem: str,
    frames_per_second: float,
    progress: Callable[[int, int], None],
) -> tuple[str, bytes]:
    """Name and content of an .mp4, or of a .zip of PNG frames where no video can be written. Raises OutputError.

    An exception that `progress` raises ends it.
    """

    def frames() -> Iterator[np.ndarray]:
        for i, camera in enumerate(cameras):
            yield draw(camera)
            progress(i + 1, len(cameras))

    try:
        check_video()
    except MissingDependency:
        return f"{stem}.zip", _zipped(frames())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{stem}.mp4"
        write_video(path, frames(), frames_per_second=frames_per_second)
        return path.name, path.read_bytes()


def _zipped(frames: Iterator[np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for i, frame in enumerate(frames):
            archive.writestr(f"{i:05d}.png", encode_png(frame))
    return buffer.getvalue()
