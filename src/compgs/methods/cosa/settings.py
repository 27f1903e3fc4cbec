"""Settings of COSA-GS; schedules are fractions of the run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from compgs.config import Config, ControlConfig, LearningRates, Range, Share, TrainingConfig
from compgs.methods.anchors.settings import ANCHOR_SETTINGS, AnchorSection

SETTINGS = (
    *ANCHOR_SETTINGS,
    "cosa",
    "training.lmbda",
    "training.entropy_lr",
    "training.phases",
)
Step = Annotated[float, Range(0, 1e3, above=True, below=True)]


@dataclass(frozen=True)
class CosaSection:
    """The causal chain, and the masks."""

    # channels of an anchor's latent (COSA-GS)
    latent_dim: Annotated[int, Range(1, 16)] = 4
    # of the contexts (COSA-GS: 24; 32 gained nothing)
    context_dim: Annotated[int, Range(1, 256)] = 24
    # of the steps: plain anchors until then, bits in the loss from then on (COSA-GS: 15 000 of 45 000)
    rate_start: Share = 1 / 3
    # of the steps: symbols in place of noise from then on (COSA-GS: never; the default preset of CompGS: 0.8)
    symbols_start: Share = 0.8
    # True: rendering and contexts see noise, too (COSA-GS); else symbols, and only the likelihood sees noise
    noise_everywhere: bool = True
    # initial learned steps: of the latent, of features, of offsets (position scales), of log scales
    latent_step: Step = 1.0
    feature_step: Step = 0.33
    offset_step: Step = 0.2
    scale_step: Step = 0.15
    # of these steps' logarithms
    step_lr: LearningRates = (5e-3, 1e-4)
    # of latents
    latent_lr: LearningRates = (0.05, 1e-3)
    # a coupled primitive exists while the sigmoid of its logit is above this (Compact-3DGS)
    mask_threshold: Annotated[float, Range(0, 1, above=True, below=True)] = 0.01
    # logit that it begins with (Compact-3DGS)
    mask_start: Annotated[float, Range(-20, 20)] = 1.0
    # of logits, for which they are to have settled well before the run's end (Compact-3DGS: 0.01 in 30 000 steps)
    mask_lr: LearningRates = (0.2, 0.01)
    # of an anchor's position, that its primitives pay for beside its other numbers
    position_bits: Annotated[float, Range(0, 63)] = 10.0
    # of the context networks' weights, so rounded as soon as there is a rate (COSA-GS)
    network_bits: Annotated[int, Range(6, 16)] = 8
    # of the rendering networks' weights, so rounded from the phase `weights` on (COSA-GS: 16, which in a small
    # scene is half of the file)
    head_bits: Annotated[int, Range(6, 16)] = 7


# What differs from the defaults of `compgs.config`: growth within the first phase.
CHANGED: Mapping[str, Mapping[str, Any]] = {
    "control": {"start": 0.05, "stop": 1 / 3, "every": 0.04, "prune_at": (), "idle_share": 0.0},
    "training": {"lmbda": 0.1},
}


@dataclass(frozen=True)
class CosaConfig(Config):
    """All settings of a run. lambda weighs a megabyte (10^6 bytes) of the file."""

    control: ControlConfig = field(default_factory=lambda: ControlConfig(**CHANGED["control"]))
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(**CHANGED["training"]))
    anchors: AnchorSection = field(default_factory=AnchorSection)
    cosa: CosaSection = field(default_factory=CosaSection)


# `paper`: ten offsets, noise to the end, 16 bits, masks as slow as the published ones of others. Made for 30 000 steps.
PRESETS = {
    "paper": {
        **CHANGED,
        "training": {**CHANGED["training"], "steps": 30_000},
        "model": {"coupled_primitives": 10},
        "cosa": {"head_bits": 16, "symbols_start": 1.0, "mask_lr": (0.01, 0.01)},
    },
    "quick": {**CHANGED, "training": {**CHANGED["training"], "steps": 4000}},
}
