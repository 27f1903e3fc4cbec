"""Which views are held out: those that a capture names, every n-th by name, or a sector."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from compgs.cameras import Camera
from compgs.errors import ConfigError
from compgs.scene.angles import angular_distances

# auto: those that the capture names, else every n-th.
Split = Literal["auto", "every", "sector"]


def check_split(split: str) -> None:
    """Raises ConfigError."""
    if split not in get_args(Split):
        raise ConfigError(f"split {split!r}: expected one of {', '.join(get_args(Split))}")


def every(names: Sequence[str], test_every: int) -> frozenset[str]:
    """Every n-th name, the first included: views between training views."""
    return frozenset(names[::test_every])


def sector(
    names: Sequence[str],
    cameras: Sequence[Camera],
    points: np.ndarray,  # [P, 3]
    extent: float,
    test_every: int,
) -> frozenset[str]:
    """The first view by name and those nearest to it in angle (`angles`), as many as `every` holds out.

    Of a ring of cameras it is an arc, of several rings a part of all: training views see the scene from elsewhere.
    """
    count = len(names[::test_every])
    order = sorted(range(len(names)), key=lambda index: names[index])
    first = order[0]
    angles = angular_distances([cameras[first]], cameras, points, extent)[0]
    angles[first] = -1.0
    nearest = sorted(range(len(names)), key=lambda index: (angles[index], names[index]))[:count]
    return frozenset(names[index] for index in nearest)
