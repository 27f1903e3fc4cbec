"""Splats to write: of every degree, with numbers such as trained ones have."""

from collections.abc import Callable

import numpy as np
import pytest

from compgs.formats import SplatArrays
from compgs.formats.arrays import harmonics_above_dc

Maker = Callable[..., SplatArrays]


def make(count: int = 40, degree: int = 3, seed: int = 0) -> SplatArrays:
    chance = np.random.default_rng(seed)
    values = {
        "means": chance.normal(size=(count, 3)) * 2,
        "log_scales": chance.normal(size=(count, 3)) - 3,
        "quaternions": chance.normal(size=(count, 4)),
        "opacity_logits": chance.normal(size=count),
        "dc": chance.normal(size=(count, 3)),
        "rest": chance.normal(size=(count, harmonics_above_dc(degree), 3)) * 0.2,
    }
    return SplatArrays(**{name: value.astype(np.float32) for name, value in values.items()})


@pytest.fixture
def made() -> Maker:
    """`made(count, degree, seed)`."""
    return make
