"""Splats to write: of every degree, with numbers such as trained ones have; and a neural scene."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from compgs.codec.encoder import to_content
from compgs.codec.writer import write_content
from compgs.config import Config, ModelConfig
from compgs.formats import SplatArrays
from compgs.formats.arrays import harmonics_above_dc
from compgs.trained_model import TrainedModel

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


@pytest.fixture(scope="session")
def cgs_bytes() -> bytes:
    """A file of about a hundred anchors with plausible latents, in a cube of two units around the origin."""
    torch.manual_seed(0)
    coordinates = np.unique(np.random.default_rng(0).integers(-20, 20, (100, 3)), axis=0).astype(np.int32)
    config = Config(model=ModelConfig(coupled_primitives=4, reference_dim=8, residuals=True, width=16))
    model = TrainedModel(config, torch.from_numpy(coordinates), 0.05, 3.0, (0.1, 0.2, 0.3))
    with torch.no_grad():
        model.references.normal_(0, 4)
        model.residuals.add_(3 * torch.randn_like(model.residuals))
        model.log_scales.normal_(0.5, 0.5)
        model.entropy.fit_covariance_prior(model.log_scales)
    return write_content(to_content(model))
