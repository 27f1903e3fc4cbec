"""Frames as a .gif, which every mail program and chat shows: 256 colors, no sound, larger than a video."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from compgs.errors import OutputError
from compgs.outputs import replacing

# Hundredths of a second, in which the format counts; most programs show what is faster than 2 of them slowly.
SHORTEST = 2


def write_animation(
    path: Path,
    frames: Iterable[np.ndarray],  # [H, W, 3] uint8, all of one size
    *,
    frames_per_second: float,
) -> int:
    """Write a .gif that repeats forever, whole or not at all; how many frames it has. Raises OutputError."""
    hundredths = max(SHORTEST, round(100 / frames_per_second))
    pictures = [_few_colors(frame) for frame in frames]
    if not pictures:
        raise OutputError(f"{path}: there are no frames to write")
    with replacing(path) as temporary:
        try:
            pictures[0].save(
                temporary,
                format="GIF",
                save_all=True,
                append_images=pictures[1:],
                duration=10 * hundredths,
                loop=0,
            )
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    return len(pictures)


def _few_colors(frame: np.ndarray) -> Image.Image:
    return Image.fromarray(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
