"""Settings that methods with such anchors have beside those of `compgs.config`."""

from dataclasses import dataclass

from compgs.config import LearningRates

# What they use of `compgs.config`.
ANCHOR_SETTINGS = (
    "anchors",
    "model.coupled_primitives",
    "model.reference_dim",
    "model.width",
    "model.voxel_size",
    "model.voxel_spacings",
    "model.max_anchors",
    "control.start",
    "control.stop",
    "control.every",
    "control.gradient_threshold",
    "control.minimum_views",
    "control.opacity_threshold",
    "control.growth_probabilities",
    "control.variant",
    "training.steps",
    "training.seed",
    "training.scale_weight",
    "training.log_scale_lr",
    "training.schedule",
    "training.phases",
    "training.exposure",
    "training.poses",
    "training.robust",
)


@dataclass(frozen=True)
class AnchorSection:
    """Learning rates of what only these anchors have."""

    # of features (Scaffold-GS: 0.0075 for 30 000 steps; here as far as the default preset's in a short run)
    feature_lr: LearningRates = (0.0165, 1e-4)
    # of offsets, in units of the position scale (Scaffold-GS)
    offset_lr: LearningRates = (0.01, 1e-4)
    # of the networks of scales and rotations, opacities and colors
    covariance_lr: LearningRates = (4e-3, 4e-5)
    opacity_lr: LearningRates = (2e-3, 2e-5)
    color_lr: LearningRates = (8e-3, 8e-5)
