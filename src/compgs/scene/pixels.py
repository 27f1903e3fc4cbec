"""Samples of an image file, of whatever type, as 8-bit display RGB: by the range that the values have.

8 bits are taken as they are. 16 bits have 65 535 for white, floating-point numbers 1. What has another range (12 bits
in a 16-bit file, floating-point numbers to 255, 32-bit integers) would be read as black or white without an error, and
is refused.
"""

import numpy as np
from PIL import Image

from compgs.scene.masks import OPAQUE

REMEDY = "convert all images to PNG or JPEG of 8 bits"
WHITE_16 = 65_535
# An image whose brightest value is darker was made of fewer bits: of 12, 10 or 8.
LEAST_WHITE_16 = 4096
TIFF_BITS, TIFF_FORMAT, SIGNED = (
    258,
    339,
    2,
)  # tags: bits of a sample; what a sample is, and one value of that


class UnusableSamples(ValueError):
    """Values of which it is not known what is white."""


def has_alpha(image: Image.Image) -> bool:
    return "A" in image.getbands() or "a" in image.getbands() or "transparency" in image.info


def is_wide(image: Image.Image) -> bool:
    """Whether colors of 16 bits become 8 bits as the image is decoded; to be asked before it is."""
    return any(";16" in str(tile) for tile in getattr(image, "tile", ()))


def rgb(
    image: Image.Image, background: tuple[float, float, float] | None, *, wide: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """[H, W, 3] uint8, and [H, W] bool, True where more than half opaque. Raises UnusableSamples.

    With a background, transparent images are composited on it, and there is no mask; nor is there for opaque images.
    `wide`: the file has 16 bits a color, of which the upper 8 are in the image.
    """
    if SIGNED in _tags(image, TIFF_FORMAT):
        raise UnusableSamples(f"samples with a sign, of which it is not known what is white; {REMEDY}")
    if image.mode == "F" or image.mode.startswith("I"):
        gray = _of_floats(np.asarray(image)) if image.mode == "F" else _of_integers(image)
        return np.repeat(gray[:, :, None], 3, axis=2), None
    colors = image.convert("RGBA" if has_alpha(image) else "RGB")
    if wide and (brightest := int(np.asarray(colors)[:, :, :3].max())) < LEAST_WHITE_16 >> 8:
        raise _too_dark(256 * brightest + 255)
    if has_alpha(image):
        rgba = np.asarray(colors)
        if background is None:
            return np.ascontiguousarray(rgba[:, :, :3]), rgba[:, :, 3] > OPAQUE
        alpha = rgba[:, :, 3:].astype(np.float32) / 255
        behind = np.asarray(background, dtype=np.float32) * 255
        return np.round(rgba[:, :, :3] * alpha + behind * (1 - alpha)).astype(np.uint8), None
    return np.array(colors), None


def _of_floats(values: np.ndarray) -> np.ndarray:  # [H, W] float32
    low, high = float(values.min()), float(values.max())
    if not (np.isfinite(values).all() and low >= -1e-3 and high <= 1 + 1e-3):
        raise UnusableSamples(
            f"floating-point samples from {low:g} to {high:g}; expected 0 for black and 1 for white; {REMEDY}"
        )
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _of_integers(image: Image.Image) -> np.ndarray:
    values = np.asarray(image).astype(np.int64)
    low, high = int(values.min()), int(values.max())
    # Formats that open in a mode of 32 bits without saying how many they have have 16.
    if max(_tags(image, TIFF_BITS), default=16) > 16 or low < 0 or high > WHITE_16:
        raise UnusableSamples(f"samples of 32 bits, of which it is not known what is white; {REMEDY}")
    if 0 < high < LEAST_WHITE_16:
        raise _too_dark(high)
    return np.round(values / 257).astype(np.uint8)


def _too_dark(brightest: int) -> UnusableSamples:
    return UnusableSamples(
        f"samples of 16 bits, none of them above {brightest}, where white is {WHITE_16}: perhaps they have fewer bits; "
        f"{REMEDY}"
    )


def _tags(image: Image.Image, tag: int) -> tuple[int, ...]:
    """Values of a TIFF's tag; none for other files."""
    tags = getattr(image, "tag_v2", None)
    found = () if tags is None else tags.get(tag, ())
    return found if isinstance(found, tuple) else (found,)
