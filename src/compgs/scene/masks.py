"""Masks: which pixels of a photograph count, in training and in metrics.

A mask is [H, W] bool, True where a pixel counts. It comes from

- a mask file, an image of the photograph's proportions: a pixel counts where it is brighter than half of the file's
  brightest (white counts, black does not, as in COLMAP and nerfstudio; 0 and 1 do as well as 0 and 255). Frames of
  nerfstudio name theirs (`mask_path`); for all layouts, `masks/` beside the photographs' folder has `a/b.jpg.png` (as
  COLMAP has it) or `a/b.png` for the photograph `a/b.jpg`;
- transparency: a pixel counts where it is more than half opaque. Only Blender scenes, whose objects stand on a
  background, and scenes that are read with a background of the user's are composited instead.

When a photograph is undistorted or reduced, a new pixel counts only if all pixels that it was computed from do: nothing
of what is masked gets into what counts.
"""

from pathlib import Path

import numpy as np
from PIL import Image

FOLDER = "masks"
OPAQUE = 127  # of 255: what is more opaque counts


def find_mask(folder: Path, name: str) -> Path | None:
    """The file in a folder of masks that belongs to the photograph of that name, if there is one."""
    photograph = folder / name
    candidates = (
        photograph.with_name(photograph.name + ".png"),
        photograph.with_suffix(".png"),
    )
    return next((path for path in candidates if path.is_file()), None)


def mask_of_brightness(gray: np.ndarray) -> np.ndarray:  # [H, W], any type
    """[H, W] bool, from the content of a mask file."""
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
