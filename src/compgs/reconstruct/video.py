"""Frames of a video: the sharpest of each stretch, since a moving hand blurs most of them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from compgs.errors import MissingDependency, SceneError, install_line

SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
SHARPNESS_WIDTH = 480  # pixels to which frames are shrunk before they are judged: noise is not sharpness


def is_video(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES


def sharpest_frames(video: Path, count: int) -> Iterator[np.ndarray]:
    """`count` frames [H, W, 3] uint8 (or all, if there are fewer), the sharpest of as many equal stretches, in order.

    Raises MissingDependency without imageio-ffmpeg, SceneError for a file that it cannot read.
    """
    frames = _frames(video)
    header = next(frames)
    width, height = header["size"]
    total = max(1, round(header["duration"] * header["fps"]))
    best: np.ndarray | None = None
    best_sharpness, stretch = -1.0, 0
    for index, data in enumerate(frames):
        frame = np.frombuffer(data, np.uint8).reshape(height, width, 3)
        if index * count // total > stretch and best is not None:
            yield best
            best_sharpness, stretch = -1.0, index * count // total
        value = sharpness(frame)
        if value > best_sharpness:
            best, best_sharpness = frame, value
    if best is None:
        raise SceneError(f"{video}: no frame could be read; is it a video?")
    if best_sharpness >= 0:
        yield best


def sharpness(image: np.ndarray) -> float:
    """Variance of the Laplacian of an image [H, W, 3] uint8 in gray, at a common width."""
    gray = Image.fromarray(image).convert("L")
    height = max(3, round(gray.height * SHARPNESS_WIDTH / gray.width))
    g = np.asarray(gray.resize((SHARPNESS_WIDTH, height), Image.Resampling.BOX), np.float32)
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var())


def _frames(video: Path) -> Iterator[Any]:
    """A dict about the video, then the bytes of each frame."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingDependency(
            f"{video}: videos need imageio-ffmpeg: {install_line('reconstruct')}"
        ) from error
    if not video.is_file():
        raise SceneError(f"{video}: does not exist; expected a video or a folder of photographs")
    reader = imageio_ffmpeg.read_frames(str(video))
    try:
        yield from reader
    except OSError as error:
        first = str(error).strip().partition("\n")[0]
        raise SceneError(f"{video}: cannot be read as a video ({first})") from error
