"""What all formats do with splats: limits, conversions, and which splats of a file are taken.

A reader ends with `drawable`, so that whatever a file says, a `SplatArrays` from it can be rendered.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from compgs.errors import SplatFileError
from compgs.model.degrees import MAX_DEGREE, degree_of, harmonics_above_dc
from compgs.model.splats import ORIGIN, SplatArrays, sigmoid
from compgs.notes import note

__all__ = [
    "MAX_DEGREE",
    "ORIGIN",
    "SplatArrays",
    "check_count",
    "degree_of",
    "drawable",
    "harmonics_above_dc",
    "joined",
    "log_scales",
    "logit",
    "normalized",
    "sigmoid",
]

MAX_LOG_SCALE = 88.0  # its exponential is the largest that float32 holds
# Of a splat that has no extent along an axis: the smallest scale that float32 holds in full precision.
FLAT_LOG_SCALE = float(np.log(np.finfo(np.float32).tiny))
MOST_DEGREE_HELD = 4  # of harmonics in files; those above MAX_DEGREE are left out
# Of quaternions, whose squares float32 holds.
SHORTEST, LONGEST = 1e-15, 1e15
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


def drawable(place: Path, arrays: SplatArrays) -> SplatArrays:
    """The splats of a file that can be drawn: what every reader ends with.

    | in the file | read as |
    |---|---|
    | the logit of an opacity is infinite | opaque, or invisible |
    | a logarithm of an extent is minus infinity | flat: the smallest extent |
    | a rotation is very long or very short | the same rotation |
    | a rotation of zero; not-a-number; an infinite position, color, rotation; an extent above exp(88) | left out |

    What is left out is counted in one note. Raises SplatFileError where that is most of the file.
    """
    arrays = _with_limits(arrays)
    reasons = _reasons(arrays)
    wrong = np.logical_or.reduce(list(reasons.values()))
    left_out = int(wrong.sum())
    if not left_out:
        return arrays
    counted = np.zeros(len(arrays), bool)
    parts = []
    for reason, rows in reasons.items():
        new = rows & ~counted  # a splat counts once, by the first thing that is wrong with it
        counted |= rows
        if new.any():
            parts.append(f"{new.sum():,} {reason} (the first is splat {int(np.argmax(new))})")
    found = "; ".join(parts)
    if 2 * left_out > len(arrays):
        raise SplatFileError(
            f"{place}: {left_out:,} of {len(arrays):,} splats cannot be drawn: {found}; the training or the export "
            "that made the file failed: repeat it"
        )
    note(place, f"{left_out:,} of {len(arrays):,} splats were left out: {found}")
    return arrays.rows(~wrong)


def _with_limits(arrays: SplatArrays) -> SplatArrays:
    """Put finite numbers in place of infinite ones that mean something; the same array where there are none."""
    logits, scales, quaternions = arrays.opacity_logits, arrays.log_scales, arrays.quaternions
    if np.isinf(logits).any():
        most = logit(np.ones(1))[0]
        logits = np.where(np.isinf(logits), np.copysign(most, logits), logits)
    if np.isneginf(scales).any():
        scales = np.where(np.isneginf(scales), np.float32(FLAT_LOG_SCALE), scales)
    largest = np.abs(quaternions).max(1)
    odd = ((largest < SHORTEST) | (largest > LONGEST)) & (largest > 0) & np.isfinite(largest)
    if odd.any():
        quaternions = quaternions.copy()
        quaternions[odd] = normalized(quaternions[odd])
    same = logits is arrays.opacity_logits and scales is arrays.log_scales
    if same and quaternions is arrays.quaternions:
        return arrays
    return replace(arrays, opacity_logits=logits, log_scales=scales, quaternions=quaternions)


def _reasons(arrays: SplatArrays) -> dict[str, np.ndarray]:
    """Why which splats [M] bool cannot be drawn, in the order in which they are asked."""

    def broken(*columns: np.ndarray) -> np.ndarray:
        rows = np.zeros(len(arrays), bool)
        for column in columns:
            rows |= ~np.isfinite(column.reshape(len(column), -1)).all(1)
        return rows

    return {
        "without a rotation (their quaternion is zero)": (arrays.quaternions == 0).all(1),
        "without a position (not a finite number)": broken(arrays.means),
        "without a size (not a number, or above exp(88))": broken(arrays.log_scales)
        | (arrays.log_scales > MAX_LOG_SCALE).any(1),
        "without a rotation (not a finite number)": broken(arrays.quaternions),
        "without an opacity (not a number)": broken(arrays.opacity_logits),
        "without a color (not a finite number)": broken(arrays.dc, arrays.rest),
    }


def log_scales(scales: np.ndarray) -> np.ndarray:
    """Logarithms of extents, float32: of zero minus infinity, of what is below zero not-a-number."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(scales.astype(np.float32))


def joined(parts: Sequence[SplatArrays]) -> SplatArrays:
    """Splats of several places of a file, in the frame of the first."""
    first = parts[0]
    if len(parts) == 1:
        return first
    degree = max(part.degree for part in parts)
    coefficients = harmonics_above_dc(degree)

    def moved(part: SplatArrays) -> SplatArrays:
        shift = np.subtract(part.world_offset, first.world_offset)
        rest = np.zeros((len(part), coefficients, 3), np.float32)
        rest[:, : part.rest.shape[1]] = part.rest
        return replace(part, means=(part.means + shift).astype(np.float32), rest=rest)

    rows = [moved(part).columns for part in parts]
    columns: dict[str, Any] = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    return replace(first, **columns)
