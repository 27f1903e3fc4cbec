"""What all formats do with splats: limits, conversions, and the check that a reader ends with.

A reader ends with `checked`, so that whatever a file says, a `SplatArrays` from it can be rendered.
"""

from pathlib import Path

import numpy as np

from compgs.errors import SplatFileError
from compgs.model.degrees import MAX_DEGREE, degree_of, harmonics_above_dc
from compgs.model.splats import ORIGIN, SplatArrays, sigmoid

__all__ = [
    "MAX_DEGREE",
    "ORIGIN",
    "SplatArrays",
    "check_count",
    "checked",
    "degree_of",
    "harmonics_above_dc",
    "logit",
    "normalized",
    "sigmoid",
]

MAX_LOG_SCALE = 88.0  # its exponential is the largest that float32 holds
# Of a splat that has no extent along an axis: the smallest scale that float32 holds in full precision.
FLAT_LOG_SCALE = float(np.log(np.finfo(np.float32).tiny))
MOST_DEGREE_HELD = 4  # of harmonics in files; those above MAX_DEGREE are left out
Y0 = 0.28209479177387814  # the harmonic of degree 0: sqrt(1 / 4 pi)
COLOR_OFFSET = 0.5  # of a color, where all coefficients are zero
# An opacity of 8 bits is 0 or 1 at its ends, of which there is no finite logit.
OPACITY_MARGIN = 1e-6
# Compressed splats take more than a bit each. A file that promises more of them than this is refused before any
# memory is taken for them; small files are left alone.
SPLATS_PER_BYTE = 8
SMALL_COUNT = 1 << 16


def logit(opacities: np.ndarray) -> np.ndarray:
    """[M] float32, finite: 0 and 1 are taken for what is next to them."""
    inside = np.clip(opacities.astype(np.float64), OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    return np.log(inside / (1 - inside)).astype(np.float32)


def normalized(quaternions: np.ndarray) -> np.ndarray:
    """[M, 4] of length 1, float64; very long and very short ones lose nothing."""
    scaled = quaternions.astype(np.float64)
    scaled /= np.abs(scaled).max(1, keepdims=True)
    return scaled / np.linalg.norm(scaled, axis=1, keepdims=True)


def check_count(place: Path, count: int, size: int) -> None:
    """Raises SplatFileError if a file of `size` bytes cannot hold so many compressed splats."""
    if count == 0:
        raise SplatFileError(f"{place}: holds no splats")
    if count > max(SMALL_COUNT, SPLATS_PER_BYTE * size):
        raise SplatFileError(f"{place}: promises {count} splats in {size} bytes; copy it again")


def checked(place: Path, arrays: SplatArrays) -> SplatArrays:
    """The same. Raises SplatFileError for the first number that nothing can be rendered from."""
    for name, array in vars(arrays).items():
        if name == "world_offset":
            continue
        bad = ~np.isfinite(array).reshape(len(array), -1)
        if name == "log_scales":
            bad |= array > MAX_LOG_SCALE
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            found = array.reshape(len(array), -1)[row, column]
            raise SplatFileError(
                f"{place}: {name} of splat {row} hold {found}, expected a finite number"
                f"{f' up to {MAX_LOG_SCALE:g}' if name == 'log_scales' else ''}; copy it again"
            )
    zero = np.flatnonzero(~arrays.quaternions.any(1))
    if len(zero):
        raise SplatFileError(
            f"{place}: the quaternion of splat {zero[0]} is zero, which is no rotation; copy it again"
        )
    return arrays
