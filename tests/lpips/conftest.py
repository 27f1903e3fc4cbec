"""Made weights of LPIPS, of the right shapes, and pictures to compare."""

import numpy as np
import pytest

from compgs.lpips import LpipsWeights
from compgs.lpips.weights import CHANNELS, STAGES

INPUTS = (3, *CHANNELS[:-1])


def pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A picture of waves and one that is disturbed, [H, W, 3] uint8, by integers alone: the same everywhere."""
    y, x = np.mgrid[:height, :width]
    a = np.stack([x * 5 % 256, (x * y) // 3 % 256, (3 * x + 2 * y) % 256], -1).astype(np.uint8)
    noise = (x[..., None] * 37 + y[..., None] * 101 + np.arange(3) * 53) ** 2 % 97 - 48
    return a, np.clip(a + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def made() -> LpipsWeights:
    rng = np.random.default_rng(0)

    def normal(*shape: int, scale: float) -> np.ndarray:
        return (scale * rng.standard_normal(shape, dtype=np.float32)).astype(np.float32)

    return LpipsWeights(
        tuple(
            normal(out, before, 3, 3, scale=(2 / (9 * before)) ** 0.5)
            for out, before in zip(CHANNELS, INPUTS, strict=True)
        ),
        tuple(normal(out, scale=0.1) for out in CHANNELS),
        tuple(np.abs(normal(stage[-1], scale=0.1)) for stage in STAGES),
    )


@pytest.fixture(scope="session")
def flat() -> LpipsWeights:
    """Every array of one value, for what is written and read: small files."""
    return LpipsWeights(
        tuple(
            np.full((out, before, 3, 3), 0.125, np.float32)
            for out, before in zip(CHANNELS, INPUTS, strict=True)
        ),
        tuple(np.full(out, 0.25, np.float32) for out in CHANNELS),
        tuple(np.full(stage[-1], 0.1, np.float32) for stage in STAGES),
    )
