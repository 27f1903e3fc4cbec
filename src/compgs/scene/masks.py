"""Masks: which pixels of a photograph count, in training and in metrics.

A mask is [H, W] bool, True where a pixel counts. It comes from

- a mask file, an image of the photograph's proportions: a pixel counts where it is brighter than half of the file's
  brightest (white counts, black does not, as in COLMAP and nerfstudio; 0 and 1 do as well as 0 and 255). Frames of
  nerfstudio name theirs (`mask_path`); for all layouts, `masks/` beside the photographs' folder has, for the photograph
  `a/b.jpg`, `a/b.jpg.png` (as COLMAP has it), `a/b.png`, `a/b.jpg.mask.png` (RealityScan) or `a/b_mask.png`
  (Metashape), or one of these lies beside the photograph itself under a name that has `mask` in it. Where a mask file
  has an alpha channel, what is transparent does not count either;
- transparency: a pixel counts where it is more than half opaque. Only Blender scenes, whose objects stand on a
  background, and scenes that are read with a background of the user's are composited instead.

When a photograph is undistorted or reduced, a new pixel counts only if all pixels that it was computed from do: nothing
of what is masked gets into what counts.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from compgs.scene.names import IMAGE_SUFFIXES, Names, without_suffix

FOLDER = "masks"
SUFFIXES = (".png", *(suffix for suffix in IMAGE_SUFFIXES if suffix != ".png"))
OPAQUE = 127  # of 255: what is more opaque counts
BLACK_AND_WHITE = 0.9  # share of pixels near either, from which a picture is a mask


def find_mask(folder: Path, name: str, names: Names) -> Path | None:
    """The file in a folder of masks that belongs to the photograph of that name, if there is one."""
    stem = without_suffix(name)
    candidates = (name, stem, f"{name}.mask", f"{stem}.mask", f"{name}_mask", f"{stem}_mask")
    found = (names.find(folder, candidate + suffix, ()) for suffix in SUFFIXES for candidate in candidates)
    return next((path for path in found if path is not None), None)


def mask_beside(photograph: Path, names: Names) -> Path | None:
    """The file beside a photograph that says by its name that it is the mask of that photograph."""
    stem = without_suffix(photograph.name)
    candidates = (f"{photograph.name}.mask", f"{stem}.mask", f"{photograph.name}_mask", f"{stem}_mask")
    found = (
        names.find(photograph.parent, candidate + suffix, ())
        for suffix in SUFFIXES
        for candidate in candidates
    )
    return next((path for path in found if path is not None), None)


def mask_of(gray: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:  # [H, W] each, any type
    """[H, W] bool, from the content of a mask file: what is bright and, with an alpha channel, opaque.

    Many programs write the mask into the alpha channel alone, over one color or over the photograph itself: where the
    opaque part is not black and white, brightness says nothing.
    """
    if alpha is None or alpha.min() > OPAQUE:
        return mask_of_brightness(gray)
    opaque = alpha > OPAQUE
    shown = gray[opaque].astype(np.float64)
    if not shown.size or shown.min() == shown.max():
        return opaque
    share = (shown - shown.min()) / (shown.max() - shown.min())
    if np.mean(np.minimum(share, 1 - share) < 0.1) < BLACK_AND_WHITE:
        return opaque
    return opaque & mask_of_brightness(gray)


def mask_of_brightness(gray: np.ndarray) -> np.ndarray:  # [H, W], any type
    """[H, W] bool: what is brighter than half of the brightest."""
    brightest = gray.max()
    return gray > brightest / 2 if brightest > 0 else np.zeros(gray.shape, dtype=bool)


def resized_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[h, w] bool of (width, height) = `size`: a pixel counts if all that it covers does."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    shares = Image.fromarray(mask.astype(np.float32)).resize(size, Image.Resampling.BOX)
    return np.asarray(shares) > 1 - 1e-4


def undistorted_mask(mask: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """mask [H, W], positions [h, w, 2] (u, v) pixels -> [h, w] bool: of what `sample_bicubic` makes there."""
    safe = _all_around(mask)
    column, row = (np.floor(positions[..., axis] - 0.5).astype(np.int64) for axis in (0, 1))
    # Further outside than that, all sixteen pixels are those of the edge.
    row, column = np.clip(row, -2, mask.shape[0]), np.clip(column, -2, mask.shape[1])
    return safe[row + 2, column + 2]


def _all_around(mask: np.ndarray) -> np.ndarray:
    """[H + 3, W + 3]: at (i + 2, j + 2), whether all count in rows i - 1 to i + 2, columns j - 1 to j + 2."""
    padded = np.pad(mask, 3, mode="edge")
    for axis in (0, 1):
        count = padded.shape[axis] - 3
        padded = np.logical_and.reduce([np.take(padded, range(k, k + count), axis) for k in range(4)])
    return padded
