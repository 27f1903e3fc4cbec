"""Pictures for pages: reduced, as data URLs, within a number of bytes; and pictures of differences."""

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

QUALITY = 85  # of WebP, of 100: above it, files grow faster than what can be seen
ROUNDS = 4  # of encoding all pictures smaller until they fit
LEAST_WIDTH = 96  # pixels; smaller ones show nothing
ROOM = 0.94  # of the bytes that a reduction aims at: sizes do not quite follow the number of pixels
BASE64 = 4 / 3  # letters for a byte
# Ends of the scale of a picture of differences, in levels of 255; the first that is not exceeded is taken.
SCALES = (4, 8, 16, 32, 64, 128, 255)
EXCEEDED = 0.01  # share of the pixels that may lie above a scale's end
# Black, purple, red, orange, white: lightness rises evenly, so that it can be read in gray, too.
COLORS = np.array([(0, 0, 0), (74, 16, 110), (190, 42, 78), (249, 150, 25), (255, 255, 240)], np.float64)


def read_picture(path: Path) -> np.ndarray | None:
    """[H, W, 3] uint8; None of a file that is missing or no picture."""
    try:
        with Image.open(path) as picture:
            return np.asarray(picture.convert("RGB"))
    except (OSError, UnidentifiedImageError, ValueError):
        return None


def levels_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[H, W] float64: of two uint8 images [H, W, 3], the mean absolute difference of a pixel's channels."""
    return np.abs(a.astype(np.int16) - b.astype(np.int16)).mean(axis=2)


def scale_for(differences: Sequence[np.ndarray]) -> int:
    """The end of a scale, in levels, that hardly a pixel of the differences exceeds."""
    for scale in SCALES:
        if all((levels > scale).mean() <= EXCEEDED for levels in differences):
            return scale
    return SCALES[-1]


def difference_picture(levels: np.ndarray, scale: int) -> np.ndarray:  # [H, W, 3] uint8
    """Black where two images agree, white where they differ by `scale` levels or more."""
    place = levels / scale * (len(COLORS) - 1)
    knots = np.arange(len(COLORS))
    channels = [np.interp(place, knots, COLORS[:, i]) for i in range(3)]
    return np.stack(channels, axis=2).round().astype(np.uint8)


def reduced(image: np.ndarray, width: int) -> np.ndarray:
    """A [H, W, 3] uint8 image, at most `width` pixels wide."""
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def webp(image: np.ndarray, width: int) -> bytes:
    """Encode a [H, W, 3] uint8 image, at most `width` pixels wide."""
    buffer = io.BytesIO()
    Image.fromarray(reduced(image, width)).save(buffer, format="WEBP", quality=QUALITY, method=4)
    return buffer.getvalue()


def data_url(data: bytes) -> str:
    """Return a data: URL that holds the image as WebP."""
    return f"data:image/webp;base64,{base64.b64encode(data).decode('ascii')}"


def urls_within(images: Sequence[np.ndarray], width: int, most_bytes: int) -> list[str]:
    """Data URLs of images, all reduced by what it takes for them to need no more letters than `most_bytes`.

    Reduced to `width` pixels first; below LEAST_WIDTH they are not reduced further, whatever it takes.
    """
    width = min(width, max((image.shape[1] for image in images), default=width))
    for _ in range(ROUNDS):
        encoded = [webp(image, width) for image in images]
        needed = BASE64 * sum(map(len, encoded))
        if needed <= most_bytes or width <= LEAST_WIDTH:
            break
        width = max(LEAST_WIDTH, int(width * math.sqrt(ROOM * most_bytes / needed)))
    return [data_url(data) for data in encoded]
