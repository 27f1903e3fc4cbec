"""Splats as files hold them, in NumPy: what readers give and writers take; torch is loaded where a model is made.

A reader ends with `checked`, so that whatever a file says, a `SplatArrays` from it can be rendered.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgs.errors import SplatFileError

if TYPE_CHECKING:
    from compgs.model.splats import Splats

MAX_DEGREE = 3
MAX_LOG_SCALE = 88.0  # its exponential is the largest that float32 holds
Y0 = 0.28209479177387814  # the harmonic of degree 0: sqrt(1 / 4 pi)
COLOR_OFFSET = 0.5  # of a color, where all coefficients are zero
# An opacity of 8 bits is 0 or 1 at its ends, of which there is no finite logit.
OPACITY_MARGIN = 1e-6
# Compressed splats take more than a bit each. A file that promises more of them than this is refused before any
# memory is taken for them; small files are left alone.
SPLATS_PER_BYTE = 8
SMALL_COUNT = 1 << 16
ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """M splats in float32, unactivated: standard deviation = exp(log scale), opacity = sigmoid(logit).

    Means count from `world_offset`, harmonics are in the order of 3DGS (`compgs.model.spherical_harmonics`).
    """

    means: np.ndarray  # [M, 3] world units
    log_scales: np.ndarray  # [M, 3]
    quaternions: np.ndarray  # [M, 4] w-x-y-z, need not be normalized, not zero
    opacity_logits: np.ndarray  # [M]
    dc: np.ndarray  # [M, 3] coefficients of degree 0, RGB
    rest: np.ndarray  # [M, K, 3] of degree 1 to `degree`: K = 0, 3, 8 or 15
    world_offset: tuple[float, float, float] = ORIGIN  # world units, float64

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the harmonics, 0 to 3."""
        return degree_of(self.rest.shape[1])

    @property
    def opacities(self) -> np.ndarray:
        """[M] in [0, 1], float64."""
        return sigmoid(self.opacity_logits)

    def each(self, change: Callable[[np.ndarray], np.ndarray]) -> "SplatArrays":
        """The same with every array changed, as by choosing rows."""
        arrays: dict[str, Any] = {
            name: change(value) for name, value in vars(self).items() if name != "world_offset"
        }
        return replace(self, **arrays)

    def rows(self, index: np.ndarray) -> "SplatArrays":
        """The splats of an index or a mask."""
        return self.each(lambda array: array[index])

    def of_degree(self, degree: int) -> "SplatArrays":
        """Without the harmonics above a degree."""
        return replace(self, rest=self.rest[:, : harmonics_above_dc(degree)])

    def splats(self) -> "Splats":
        """For a model; the arrays are copied."""
        import torch

        from compgs.model.splats import Splats

        arrays = {name: value for name, value in vars(self).items() if name != "world_offset"}
        return Splats(**{name: torch.tensor(value, dtype=torch.float32) for name, value in arrays.items()})


def arrays_of(splats: "Splats", world_offset: tuple[float, float, float] = ORIGIN) -> SplatArrays:
    """Inverse of `SplatArrays.splats`."""
    arrays = {name: tensor.detach().cpu().float().numpy() for name, tensor in vars(splats).items()}
    return SplatArrays(**arrays, world_offset=world_offset)


def harmonics_above_dc(degree: int) -> int:
    """Number of basis functions of degree 1 to `degree`: 0, 3, 8 or 15."""
    return (degree + 1) ** 2 - 1


def degree_of(count: int) -> int:
    """Inverse of `harmonics_above_dc`."""
    return next(d for d in range(MAX_DEGREE + 1) if harmonics_above_dc(d) == count)


def sigmoid(logits: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-logits.astype(np.float64)))


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
