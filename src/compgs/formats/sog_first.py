"""Splats of a .sog file of version 1 (SOGS): images as in version 2, whose bytes lie evenly between two ends.

| image | channels | value |
|---|---|---|
| means: low, high | RGB | as in version 2 |
| scales | RGB | between `mins` and `maxs` of each axis: log scales |
| quats | RGB A | as in version 2 |
| sh0 | RGB A | between the four `mins` and `maxs`: coefficients of degree 0, and the logit of the opacity |
| shN: centroids | RGB | a palette, 64 entries a row, between the numbers `mins` and `maxs`; its width says the degree |
| shN: labels | RG | 16 bits: which entry |

There is neither `version` nor `count`: `means.shape` begins with the number of splats. Only read here.
"""

import numpy as np

from compgs.errors import SplatFileError
from compgs.formats.arrays import MAX_DEGREE, SplatArrays, harmonics_above_dc
from compgs.formats.sog_files import (
    BOOK,
    MOST_ENTRIES,
    PALETTE_ROW,
    SogFiles,
    decoded,
    harmonics,
    number,
    numbers,
    pixels,
    positions,
    rotations,
)


def splats(files: SogFiles) -> SplatArrays:
    """Raises SplatFileError."""
    colors = _between(files, "sh0", pixels(files, "sh0", 0, 4))
    return SplatArrays(
        means=positions(files),
        log_scales=_between(files, "scales", pixels(files, "scales", 0, 3)),
        quaternions=rotations(files),
        opacity_logits=colors[:, 3].copy(),
        dc=colors[:, :3].copy(),
        rest=_palette_entries(files) if "shN" in files.meta else np.zeros((files.count, 0, 3), np.float32),
    )


def _between(files: SogFiles, name: str, steps: np.ndarray) -> np.ndarray:
    """[M, channels] float32: 0 is the lower end of a channel, 255 the upper one."""
    low, high = (numbers(files, name, key, steps.shape[1]).astype(np.float64) for key in ("mins", "maxs"))
    return (low + (high - low) * steps / 255).astype(np.float32)


def _palette_entries(files: SogFiles) -> np.ndarray:
    """[count, K, 3] float32."""
    low, high = (number(files, "shN", key) for key in ("mins", "maxs"))
    widths = {PALETTE_ROW * harmonics_above_dc(bands): bands for bands in range(1, MAX_DEGREE + 1)}
    table = decoded(files, "shN", 0, 3, max(widths) * MOST_ENTRIES // PALETTE_ROW)
    bands = widths.get(table.shape[1])
    if bands is None:
        expected = ", ".join(map(str, widths))
        raise SplatFileError(
            f"{files.place}: a palette of {table.shape[1]} pixels a row; expected {expected} (degree 1 to 3)"
        )
    book = (low + (high - low) * np.arange(BOOK) / (BOOK - 1)).astype(np.float32)
    return harmonics(files, table, bands, len(table) * PALETTE_ROW, book)
