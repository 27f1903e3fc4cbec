"""A checkpoint comes from a file, and files may be damaged: what is restored from one is checked like any input.

Values that nothing else would stop are looked at here; whatever else goes wrong while a run is put together again
becomes a CheckpointError, too.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from compgs.errors import CheckpointError, ConfigError, SceneError

# What Python, torch and numpy raise for content of another kind than was written.
_MISFITS = (
    ConfigError, SceneError, ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError,
    OverflowError, RecursionError, AssertionError,
)  # fmt: skip


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Turn any error inside into a CheckpointError for `path`."""
    try:
        yield
    except CheckpointError:
        raise
    except _MISFITS as error:
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise CheckpointError(
            f"{path}: the checkpoint is damaged ({reason}); copy it again, or train anew"
        ) from error


def check_tensors(found: Mapping[str, Tensor], expected: Mapping[str, Tensor], what: str) -> None:
    """Raises ValueError, naming it, for the first tensor that is not of the expected name, type and shape, or that
    holds a value that is not finite."""
    if found.keys() != expected.keys():
        differing = ", ".join(sorted(found.keys() ^ expected.keys())[:3])
        raise ValueError(f"{what}: expected other tensors than were found, see {differing}")
    for name, value in found.items():
        check_tensor(value, expected[name].shape, expected[name].dtype, f"{what} {name}")


def check_tensor(value: Tensor, shape: Sequence[int], dtype: torch.dtype, what: str) -> None:
    """Raises ValueError for another shape or type, or values that are not finite."""
    if tuple(value.shape) != tuple(shape) or value.dtype != dtype:
        raise ValueError(
            f"{what}: expected {list(shape)} of {dtype}, found {list(value.shape)} of {value.dtype}"
        )
    if value.is_floating_point() and not torch.isfinite(value).all():
        raise ValueError(f"{what}: holds values that are not finite")


ADAM = ("step", "exp_avg", "exp_avg_sq")


def check_moments(tensors: Mapping[str, Tensor], parameters: Mapping[str, Tensor]) -> None:
    """Raises ValueError, KeyError for what is not Adam's moments, by `parameter/moment`."""
    found: dict[str, set[str]] = {}
    for name, value in tensors.items():
        parameter, moment = name.rsplit("/", 1)
        of = parameters[parameter]
        if moment not in ADAM:
            raise ValueError(f"{name} is no moment of Adam's")
        shape: Sequence[int] = () if moment == "step" else of.shape
        check_tensor(value, shape, torch.float32 if moment == "step" else of.dtype, f"moment {name}")
        if moment in ("step", "exp_avg_sq") and (value < 0).any():
            raise ValueError(f"moment {name}: expected nothing below 0")
        found.setdefault(parameter, set()).add(moment)
    for parameter, moments in found.items():
        missing = {*ADAM} - moments
        if missing:
            raise ValueError(f"moments are missing, such as {parameter}/{min(missing)}")


def check_step(state: Mapping[str, Any], steps: int) -> None:
    """Check the step of the run's state. Raises ValueError for a step outside of the run."""
    whole_number(state["step"], 0, steps, "step")


def whole_number(value: Any, least: int, most: int, what: str) -> int:
    """Raises ValueError for anything else."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{what}: expected {least} to {most}, found {value!r:.60}")
    return value


def finite(values: Any, count: int, what: str, *, above: float = -math.inf) -> tuple[float, ...]:
    """So many numbers of a list. Raises ValueError for anything else."""
    sound = isinstance(values, list) and len(values) == count
    if not sound or not all(_is_number(v) and math.isfinite(v) and v > above for v in values):
        raise ValueError(f"{what}: expected {count} finite numbers, found {values!r:.60}")
    return tuple(map(float, values))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
