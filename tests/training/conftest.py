"""Settings for a scene small enough to train in a second."""

import pytest

from compgs.config import Config, ControlConfig, ModelConfig, TrainingConfig

from .rules import SIZES_AS_SET


@pytest.fixture
def tiny_config() -> Config:
    return Config(
        model=ModelConfig(
            coupled_primitives=4,
            reference_dim=8,
            residuals=True,
            residual_dim=8,
            width=16,
            voxel_size=0.1,
        ),
        control=ControlConfig(start=0.2, stop=0.7, every=0.2, minimum_views=4, gradient_threshold=1e-5),
        # PSNR judges what so short runs learn: the weight of SSIM is that of 3DGS.
        training=TrainingConfig(steps=40, seed=3, rules=SIZES_AS_SET, ssim_weight=0.2),
    )
