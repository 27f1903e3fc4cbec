"""What tests of several rooms need: Ctrl-C that is heard, a small .cgs file, and a browser."""

import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.codec.encoder import to_content
from compgs.codec.writer import write_content
from compgs.config import Config, ModelConfig
from compgs.evaluation.camera_path import orbit
from compgs.trained_model import TrainedModel


def pytest_configure() -> None:
    # Whoever starts the tests in the background starts them with Ctrl-C ignored, and so their child processes.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


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
    positions = coordinates * 0.05
    model.viewpoints = tuple(
        camera
        for elevation in (10.0, 40.0)
        for _, camera in orbit(positions, frames=6, width=64, height=48, elevation=elevation)
    )
    return write_content(to_content(model))


@pytest.fixture
def tiny_cgs(tmp_path: Path, cgs_bytes: bytes) -> Path:
    """That file."""
    path = tmp_path / "tiny.cgs"
    path.write_bytes(cgs_bytes)
    return path


@pytest.fixture(scope="session")
def browser() -> str:
    """Path of a Chromium; tests that need one are skipped where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if path := shutil.which(name):
            return path
    pytest.skip("no Chromium is on PATH")
