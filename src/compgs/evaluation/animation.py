"""Frames as an animation, which pages and chats show: .webp, or .gif, which every mail program shows in 256 colors."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from compgs.errors import OutputError
from compgs.outputs import replacing

# Hundredths of a second, in which a .gif counts; most programs show what is faster than 2 of them slowly.
SHORTEST = 2
WEBP_QUALITY = 70  # of 100: a page loads it before it shows anything


def write_animation(
    path: Path,
    frames: Iterable[np.ndarray],  # [H, W, 3] uint8, all of one size
    *,
    frames_per_second: float,
) -> int:
    """Write a .gif or .webp that repeats forever, whole or not at all; return the number of its frames.

    Raises OutputError.
    """
    webp = path.suffix.lower() == ".webp"
    pictures = [Image.fromarray(frame) if webp else _few_colors(frame) for frame in frames]
    if not pictures:
        raise OutputError(f"{path}: there are no frames to write")
    options: dict[str, Any]
    if webp:
        options = {
            "format": "WEBP",
            "duration": round(1000 / frames_per_second),
            "quality": WEBP_QUALITY,
            "method": 4,
        }
    else:
        options = {"format": "GIF", "duration": 10 * max(SHORTEST, round(100 / frames_per_second))}
    with replacing(path) as temporary:
        try:
            pictures[0].save(temporary, save_all=True, append_images=pictures[1:], loop=0, **options)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    return len(pictures)


def labelled(frame: np.ndarray, text: str) -> np.ndarray:
    """Return the frame [H, W, 3] uint8 with a line of text in its lower left corner, white on a dark bar."""
    picture = Image.fromarray(frame)
    draw = ImageDraw.Draw(picture, "RGBA")
    size = max(10, picture.height // 16)
    left, top, right, bottom = draw.textbbox((0, 0), text, font_size=size)
    margin = size // 2
    at = (2 * margin, picture.height - 2 * margin - (bottom - top))
    draw.rectangle(
        [at[0] - margin, at[1] - margin, at[0] + right - left + margin, at[1] + bottom - top + margin],
        fill=(0, 0, 0, 160),
    )
    draw.text((at[0] - left, at[1] - top), text, fill="white", font_size=size)
    return np.asarray(picture)


def _few_colors(frame: np.ndarray) -> Image.Image:
    return Image.fromarray(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
