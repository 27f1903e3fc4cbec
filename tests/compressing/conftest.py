"""Scenes of a few hundred splats: a ball to walk around, and a room to stand in."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from compgs.formats import write_ply
from compgs.model.splats import SplatArrays, SplatModel

FLOATERS = 12


def splats_at(means: np.ndarray, size: float, opacity: float = 0.95, seed: int = 0) -> SplatArrays:
    """Round splats of one size, colored by where they are."""
    count = len(means)
    turns = np.random.default_rng(seed).normal(size=(count, 4))
    colors = np.clip(0.5 + 0.4 * means / np.abs(means).max(), 0.05, 0.95)
    return SplatArrays(
        means=means.astype(np.float32),
        log_scales=np.full((count, 3), np.log(size), np.float32),
        quaternions=turns.astype(np.float32),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        dc=((colors - 0.5) / 0.28209479177387814).astype(np.float32),
        rest=np.zeros((count, 3, 3), np.float32),
    )


def joined(*parts: SplatArrays) -> SplatArrays:
    return SplatArrays(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in parts[0].columns}
    )


@pytest.fixture(scope="session")
def make_splats() -> Callable[..., SplatArrays]:
    """`make_splats(means, size)`."""
    return splats_at


@dataclass(frozen=True)
class Made:
    """A scene and what is known of it."""

    model: SplatModel
    solid: np.ndarray  # indices of the splats that matter


@pytest.fixture(scope="session")
def ball() -> Made:
    """300 splats on a sphere of radius 1 around (3, 0, 0); a few faint floaters far away."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surface = splats_at(directions, 0.12)
    far = splats_at(rng.normal(size=(FLOATERS, 3)) * 60, 0.12, opacity=0.02)
    splats = joined(surface, far)
    splats = replace(splats, means=splats.means + np.array([3.0, 0.0, 0.0], np.float32))
    return Made(SplatModel(splats, (0.0, 0.0, 0.0)), np.arange(300))


@pytest.fixture(scope="session")
def room() -> Made:
    """Walls, floor and ceiling of a cube of half side 2, closed to all sides, and a table in the middle."""
    rng = np.random.default_rng(2)
    walls = rng.uniform(-2, 2, size=(1500, 3))
    walls[np.arange(1500), np.arange(1500) % 3] = np.where(np.arange(1500) % 2, 2.0, -2.0)
    table = rng.uniform(-0.4, 0.4, size=(600, 3))
    splats = joined(splats_at(walls, 0.22), splats_at(table, 0.08))
    return Made(SplatModel(splats, (0.0, 0.0, 0.0)), np.arange(2100))


@pytest.fixture(scope="session")
def ball_ply(ball: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "ball.ply"
    write_ply(ball.model.splats, path)
    return path
