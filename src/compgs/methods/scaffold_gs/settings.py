"""Settings of Scaffold-GS."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from compgs.config import Config, ControlConfig, ModelConfig, Phases, TrainingConfig
from compgs.methods.anchors.settings import AnchorSection

# What differs from the defaults of `compgs.config`, as in the authors' release; schedules as fractions of its 30 000
# steps: growth each 100 of them from 1 500 to 15 000. A primitive is judged when it was seen in more than 40 steps, an
# anchor when it was in view in 80 of 100.
PUBLISHED: Mapping[str, Mapping[str, Any]] = {
    "model": {"coupled_primitives": 10, "voxel_spacings": 1.0},
    "control": {
        "start": 0.05,
        "stop": 0.5,
        "every": 1 / 300,
        "gradient_threshold": 2e-4,
        "minimum_views": 41,
        "opacity_threshold": 0.005,
        "growth_probabilities": (0.5, 0.75, 0.875),
        "variant": "scaffold-gs",
    },
    "training": {
        "steps": 30_000,
        "schedule": "exponential",
        "phases": Phases(warm=0.0),
    },
    "anchors": {
        "feature_lr": (7.5e-3, 7.5e-3),
        "covariance_lr": (4e-3, 4e-3),
        "color_lr": (8e-3, 5e-5),
    },
}
# For runs of hundreds or few thousands of steps: features that learn faster and settle, and this project's schedule.
# In 600 steps that is 1.2 dB.
SCALED = {
    **PUBLISHED,
    "training": {"schedule": "cosine"},
    "anchors": {"feature_lr": (0.0165, 1e-4)},
}


@dataclass(frozen=True)
class ScaffoldConfig(Config):
    """All settings of a run."""

    model: ModelConfig = field(default_factory=lambda: ModelConfig(**PUBLISHED["model"]))
    control: ControlConfig = field(default_factory=lambda: ControlConfig(**PUBLISHED["control"]))
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(**PUBLISHED["training"]))
    anchors: AnchorSection = field(default_factory=lambda: AnchorSection(**PUBLISHED["anchors"]))
