"""Settings: one typed line each, with unit and source. A preset file holds only what differs.

`Config()` is the `default` preset. Schedules are given as fractions of the run, so that a run of 2 000 steps and
one of 30 000 go through the same phases. "Ref." marks values of the authors' released configuration.
"""

import dataclasses
import tomllib
import typing
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Literal

from compgs.errors import ConfigError

PRESETS = ("default", "paper", "quick")
MAX_VIEWPOINTS = 64  # 13 bytes each; more would say nothing new


@dataclass(frozen=True)
class ModelConfig:
    """Hybrid primitives and their prediction (Sec. 3.1, 3.2)."""

    coupled_primitives: int = 5  # K, per anchor (10 in Sec. 3.4: slower, and no better at the same size)
    reference_dim: int = 32  # channels of a reference embedding (Sec. 3.4)
    residual_dim: int = 8  # channels of a residual embedding (Sec. 3.4)
    residuals: bool = (
        False  # True: each anchor has its own K residual embeddings (Sec. 3.1); else all share K of them
    )
    width: int = 32  # hidden width of the residual MLPs (Ref.)
    heads: Literal["separate", "paired"] = (
        "paired"  # separate: four networks (Sec. 3.2); paired: geometry, appearance
    )
    voxel_size: float | None = (
        None  # world units between neighbouring anchors; None: from the points' spacing
    )
    voxel_spacings: float = 1.5  # median distances of the points to a voxel, where voxel_size is not given
    point_colors: bool = (
        True  # anchors start with the colors of the points, in three channels of their references
    )
    max_anchors: int = 1_000_000  # growth stops here


@dataclass(frozen=True)
class EntropyConfig:
    """Quantization and rate (Sec. 3.3)."""

    reference_hyper_dim: int = 4  # hyperprior channels of a reference embedding (Ref.)
    reference_step: float = (
        0.33  # quantization step of reference embeddings (1 in Sec. 3.4 costs 0.5 dB in short runs)
    )
    residual_step: float = 0.5  # quantization step of residual embeddings (1 in Sec. 3.4)
    covariance_step: float = (
        0.15  # initial learned step of the anchors' log scales (0.01 in Sec. 3.4: bits for what nobody sees)
    )
    # of the steps: references are turned into their principal axes, at the last of them channels that hardly say
    # anything are dropped (not in the paper)
    decorrelate_at: tuple[float, ...] = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
    quantized: bool = True  # False: latents are trained unrounded, as a bound that no file reaches (ablation)
    network_blocks: int = 0  # residual blocks of the entropy networks (two in Sec. 3.4); 0: one linear layer
    network_width: int = 32  # of their hidden layers (Ref.)
    network_bits: int = (
        10  # of the entropy networks' weights in the file; the run trains with them so rounded
    )
    head_bits: int = 7  # of the prediction heads' weights in the file


@dataclass(frozen=True)
class ControlConfig:
    """Adaptive control of the anchors: growth and pruning (Ref.); schedule and short runs: `training/control.py`."""

    start: float = 0.15  # of the steps: first control
    # passes over the training views, after which the first control comes if that is earlier (Ref.: 5)
    start_passes: float | None = None
    stop: float = 0.5  # of the steps: no control from here on (Ref.)
    every: float = 0.05  # of the steps between two controls, at least one pass over the training views
    # passes over the training views between two controls, if these are fewer steps (Ref.: 2)
    every_passes: float | None = None
    # passes over the training views before statistics are gathered, if the first control leaves the time (Ref.: 3)
    observe_passes: float = 0.0
    gradient_threshold: float = 1e-4  # mean norm of the 2D gradient, in units of half the image
    rate_exponent: float = (
        1 / 3  # threshold and pruned share grow with this power of lambda / 0.002: anchors cost bits
    )
    minimum_views: int = 20  # a primitive seen less often is not judged (Ref.: more than 40), ...
    # ... unless it was seen in this share of the steps between two controls: where these are few, no primitive is seen
    # 40 times. Above 1 it takes several controls, and needs statistics that outlast them (`reset_all` false).
    minimum_share: float = 2.0
    opacity_threshold: float = (
        5e-4  # anchors with less opacity, summed over K, averaged over views, are removed
    )
    opacity_views: int = 5  # an anchor in view less often is not removed for its opacity (Ref.: 1) ...
    opacity_share: float = 0.1  # ... nor in a smaller share of the steps between two controls (Ref.: 0)
    reset_all: bool = False  # after a control all statistics start anew (Ref.: true), else of what was judged
    # with which a candidate for a cell of 16, 4, 1 voxels is kept (Ref.: 0.5, 0.75, 0.875)
    growth_probabilities: tuple[float, float, float] = (0.5, 0.25, 0.125)
    # cells of 4 and 1 voxels are tried only in a control that has grown anchors in larger ones (Ref.: true)
    finer_needs_coarser: bool = False
    idle_share: float = (
        0.002  # of all blending weights in training views: what adds no more is left out of the file
    )
    prune_at: tuple[float, ...] = (0.5, 0.6, 0.7)  # of the steps: the anchors that add least are removed
    prune_share: float = 0.02  # of all blending weights in training views, that go each time


@dataclass(frozen=True)
class TrainingConfig:
    """Rate-distortion optimization (Sec. 3.4)."""

    steps: int = 30_000  # one view each
    seed: int = 0
    lmbda: float = (
        0.002  # weight of the rate; 0: the entropy networks learn what the latents cost, these do not care
    )
    target_bytes: int | None = None  # size of the file to aim at: lambda, from its setting on, follows it
    rate: Literal["bits", "elements"] = (
        "bits"  # bits: true bits, normalized so that lambda means the same as in
    )
    #   the paper; elements: sum over the tensors of mean bits per element (Ref.)
    rate_start: float = 0.1  # of the steps before the rate joins the loss (Ref.: 3 000 of 30 000)
    ssim_weight: float = 0.2  # (1 - w) L1 + w (1 - SSIM) (3DGS)
    scale_weight: float = 0.01  # mean product of the primitives' scales, see `losses.scale_unit` (Ref.)
    embedding_lr: tuple[float, float] = (0.05, 3e-4)  # quantization steps per training step, first and last
    log_scale_lr: tuple[float, float] = (0.007, 0.007)  # Ref.
    translation_lr: tuple[float, float] = (2e-3, 2e-5)  # Ref.
    covariance_lr: tuple[float, float] = (4e-3, 4e-5)  # Ref.
    opacity_lr: tuple[float, float] = (2e-3, 2e-5)  # Ref.
    color_lr: tuple[float, float] = (8e-3, 8e-5)  # Ref.
    schedule: Literal["cosine", "exponential"] = "cosine"  # of all these rates (Sec. 4.1; Ref.: exponential)
    head_warm_up: float = 0.05  # of the steps in which the heads come up to their learning rates
    entropy_lr: tuple[float, float] = (5e-3, 1e-4)  # of the entropy model (Ref.: 2e-4 -> 1e-5)
    # steps for which entropy_lr is meant: a shorter run multiplies it by as much as it is shorter, so that the networks
    # get as far; 0: as it is given
    entropy_lr_steps: int = 0
    quantized_weights: float = (
        0.8  # of the steps before the networks' weights are trained as they will be stored
    )
    sparse_adam: bool = (
        False  # Adam moves, and lets decay the moments of, only the anchors in view (Taming 3DGS)
    )
    appearance_dtype: Literal["float32", "bfloat16"] = (
        "float32"  # in which the networks of opacity and color compute; bfloat16 is meant for GPUs
    )
    hard_rate: float = (
        0.8  # of the steps before the likelihood sees symbols in place of noise (soft then hard)
    )
    left_out: float = 0.2  # of the primitives, that a step does without, where training views are few
    viewpoints: int = 12  # cameras of training views that the file keeps, to look from; 0: none
    checkpoint_minutes: float = (
        5.0  # between two checkpoints; one is also written when the run is interrupted
    )


@dataclass(frozen=True)
class SplatConfig:
    """Plain 3D Gaussian Splatting (`--method 3dgs`; Kerbl et al. 2023), as published; schedules as fractions of its
    30 000 steps, with floors for short runs (`training/densification.py`).
    """

    harmonics: int = 3  # degree of the spherical harmonics at the end
    harmonics_every: float = 1 / 30  # of the steps between two degrees (1 000 of 30 000)
    initial_opacity: float = 0.1  # of the splats that the points become
    position_lr: tuple[float, float] = (1.6e-4, 1.6e-6)  # scene extents per step, first and last
    color_lr: float = 2.5e-3  # of harmonic coefficients of degree 0
    harmonics_lr: float = 1.25e-4  # of the degrees above: a twentieth
    opacity_lr: float = 0.05  # of logits
    log_scale_lr: float = 5e-3
    rotation_lr: float = 1e-3  # of quaternions
    densify_start: float = 1 / 60  # of the steps (500 of 30 000)
    densify_stop: float = 0.5  # of the steps (15 000)
    densify_every: float = 1 / 300  # of the steps (100)
    gradient_threshold: float = 2e-4  # mean norm of the 2D gradient, in units of half the image
    split_size: float = 0.01  # scene extents: larger splats are split, smaller ones cloned
    prune_opacity: float = 0.005  # splats with less are removed
    prune_size: float = 0.1  # scene extents: larger splats are removed once opacities have been reset
    reset_every: float = 0.1  # of the steps (3 000) between two resets of the opacities
    reset_opacity: float = 0.01  # what opacities are reset to, where they are above
    max_splats: int = 6_000_000  # growth stops here; the largest published scenes have about as many


@dataclass(frozen=True)
class Config:
    """All settings of a run."""

    model: ModelConfig = field(default_factory=ModelConfig)
    entropy: EntropyConfig = field(default_factory=EntropyConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    splats: SplatConfig = field(default_factory=SplatConfig)

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def _section(kind: type, values: dict[str, Any], place: str) -> Any:
    hints = typing.get_type_hints(kind)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ConfigError(f"{place}: unknown setting {unknown[0]!r}; known: {', '.join(sorted(hints))}")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def config_from_dict(values: dict[str, Any], place: str = "settings") -> Config:
    """Inverse of `Config.to_dict`. Raises ConfigError on unknown names or values out of range."""
    hints = typing.get_type_hints(Config)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ConfigError(f"{place}: unknown section {unknown[0]!r}; known: {', '.join(hints)}")
    config = Config(**{k: _section(hints[k], v, f"{place}: [{k}]") for k, v in values.items()})
    check_config(config)
    return config


def load_config(preset: str = "default") -> Config:
    """The settings of a preset: `default`, `paper` or `quick`. Raises ConfigError for any other name."""
    if preset not in PRESETS:
        raise ConfigError(f"preset {preset!r} does not exist; there are {', '.join(PRESETS)}")
    file = resources.files("compgs.presets") / f"{preset}.toml"
    return config_from_dict(tomllib.loads(file.read_text(encoding="utf-8")), f"preset {preset}")


def check_config(config: Config) -> None:
    """Raises ConfigError for the first setting that is out of range."""
    m, e, t, c, s = config.model, config.entropy, config.training, config.control, config.splats
    rules = [
        ("model.coupled_primitives", 1 <= m.coupled_primitives <= 64, "1 to 64"),
        ("model.reference_dim", 1 <= m.reference_dim <= 256, "1 to 256"),
        ("model.residual_dim", 1 <= m.residual_dim <= 64, "1 to 64"),
        ("model.residuals", isinstance(m.residuals, bool), "true or false"),
        ("model.width", 8 <= m.width <= 256 and m.width % 8 == 0, "a multiple of 8 up to 256"),
        ("model.heads", m.heads in ("separate", "paired"), "separate or paired"),
        ("model.voxel_size", m.voxel_size is None or 0 < m.voxel_size < float("inf"), "above 0"),
        ("model.voxel_spacings", 0 < m.voxel_spacings < 1e6, "above 0"),
        (
            "model.point_colors",
            isinstance(m.point_colors, bool) and (m.reference_dim >= 3 or not m.point_colors),
            "true or false; true needs a model.reference_dim of 3 or more",
        ),
        ("model.max_anchors", 1 <= m.max_anchors <= 1 << 24, "1 to 16777216"),
        ("entropy.reference_hyper_dim", 1 <= e.reference_hyper_dim <= 64, "1 to 64"),
        ("entropy.reference_step", 0 < e.reference_step < 1e3, "above 0"),
        ("entropy.residual_step", 0 < e.residual_step < 1e3, "above 0"),
        ("entropy.covariance_step", 0 < e.covariance_step < 10, "above 0"),
        ("entropy.decorrelate_at", all(0 <= at <= 1 for at in e.decorrelate_at), "numbers from 0 to 1"),
        ("entropy.network_bits", 6 <= e.network_bits <= 16, "6 to 16"),
        ("entropy.head_bits", 6 <= e.head_bits <= 16, "6 to 16"),
        ("training.steps", 1 <= t.steps <= 10_000_000, "1 to 10000000"),
        ("training.lmbda", 0 <= t.lmbda <= 100, "0 to 100"),
        ("training.target_bytes", t.target_bytes is None or 0 < t.target_bytes < 1 << 40, "above 0"),
        ("training.rate", t.rate in ("bits", "elements"), "bits or elements"),
        ("training.rate_start", 0 <= t.rate_start <= 1, "0 to 1"),
        ("training.seed", 0 <= t.seed < 1 << 31, "0 to 2147483647"),
        ("entropy.network_blocks", 0 <= e.network_blocks <= 3, "0 to 3"),
        ("entropy.network_width", 1 <= e.network_width <= 1024, "1 to 1024"),
        ("training.entropy_lr_steps", 0 <= t.entropy_lr_steps <= 10_000_000, "0 to 10000000"),
        ("training.ssim_weight", 0 <= t.ssim_weight <= 1, "0 to 1"),
        ("training.scale_weight", 0 <= t.scale_weight < 1e6, "0 or more"),
        ("training.quantized_weights", 0 <= t.quantized_weights <= 1, "0 to 1"),
        ("training.schedule", t.schedule in ("cosine", "exponential"), "cosine or exponential"),
        ("training.hard_rate", 0 <= t.hard_rate <= 1, "0 to 1"),
        ("training.left_out", 0 <= t.left_out <= 0.5, "0 to 0.5"),
        ("training.head_warm_up", 0 <= t.head_warm_up <= 1, "0 to 1"),
        ("training.sparse_adam", isinstance(t.sparse_adam, bool), "true or false"),
        ("training.appearance_dtype", t.appearance_dtype in ("float32", "bfloat16"), "float32 or bfloat16"),
        ("training.viewpoints", 0 <= t.viewpoints <= MAX_VIEWPOINTS, f"0 to {MAX_VIEWPOINTS}"),
        ("training.checkpoint_minutes", 0 < t.checkpoint_minutes < 1e6, "above 0"),
        ("control.start", 0 <= c.start <= 1, "0 to 1"),
        ("control.start_passes", c.start_passes is None or 0 < c.start_passes < 1e6, "above 0"),
        ("control.stop", 0 <= c.stop <= 1, "0 to 1"),
        ("control.every", 0 < c.every <= 1, "above 0, up to 1"),
        ("control.every_passes", c.every_passes is None or 0 < c.every_passes < 1e6, "above 0"),
        ("control.observe_passes", 0 <= c.observe_passes < 1e6, "0 or more"),
        ("control.gradient_threshold", 0 < c.gradient_threshold < 1e6, "above 0"),
        ("control.rate_exponent", 0 <= c.rate_exponent <= 2, "0 to 2"),
        ("control.minimum_views", 0 <= c.minimum_views < 1 << 31, "0 or more"),
        ("control.minimum_share", 0 < c.minimum_share < 1e6, "above 0"),
        ("control.opacity_threshold", 0 <= c.opacity_threshold < 1e3, "0 or more"),
        ("control.opacity_views", 1 <= c.opacity_views < 1 << 31, "1 or more"),
        ("control.opacity_share", 0 <= c.opacity_share < 1e6, "0 or more"),
        ("control.reset_all", isinstance(c.reset_all, bool), "true or false"),
        ("control.idle_share", 0 <= c.idle_share < 1, "0 or more, below 1"),
        ("control.prune_at", all(0 <= at <= 1 for at in c.prune_at), "numbers from 0 to 1"),
        ("control.prune_share", 0 <= c.prune_share < 1, "0 or more, below 1"),
        (
            "control.growth_probabilities",
            len(c.growth_probabilities) == 3 and all(0 <= p <= 1 for p in c.growth_probabilities),
            "three numbers from 0 to 1",
        ),
        ("control.finer_needs_coarser", isinstance(c.finer_needs_coarser, bool), "true or false"),
        ("splats.harmonics", 0 <= s.harmonics <= 3, "0 to 3"),
        ("splats.harmonics_every", 0 <= s.harmonics_every <= 1, "0 to 1"),
        ("splats.initial_opacity", 0 < s.initial_opacity < 1, "above 0, below 1"),
        ("splats.densify_start", 0 <= s.densify_start <= 1, "0 to 1"),
        ("splats.densify_stop", 0 <= s.densify_stop <= 1, "0 to 1"),
        ("splats.densify_every", 0 < s.densify_every <= 1, "above 0, up to 1"),
        ("splats.gradient_threshold", 0 < s.gradient_threshold < 1e6, "above 0"),
        ("splats.split_size", 0 < s.split_size < 1e6, "above 0"),
        ("splats.prune_opacity", 0 <= s.prune_opacity < 1, "0 or more, below 1"),
        ("splats.prune_size", 0 < s.prune_size < 1e6, "above 0"),
        ("splats.reset_every", 0 < s.reset_every <= 1, "above 0, up to 1"),
        ("splats.reset_opacity", s.prune_opacity < s.reset_opacity < 1, "above prune_opacity, below 1"),
        ("splats.max_splats", 1 <= s.max_splats <= 1 << 26, "1 to 67108864"),
        (
            "splats.position_lr",
            len(s.position_lr) == 2 and all(0 < r < 100 for r in s.position_lr),
            "two learning rates above 0, first and last",
        ),
    ]
    for name in ("color_lr", "harmonics_lr", "opacity_lr", "log_scale_lr", "rotation_lr"):
        rules.append((f"splats.{name}", 0 < getattr(s, name) < 100, "a learning rate above 0"))
    for name, rates in dataclasses.asdict(t).items():
        if name.endswith("_lr"):
            good = len(rates) == 2 and all(0 < rate < 100 for rate in rates)
            rules.append((f"training.{name}", good, "two learning rates above 0, first and last"))
    for name, good, legal in rules:
        if not good:
            section, key = name.split(".")
            raise ConfigError(f"{name} = {getattr(getattr(config, section), key)!r}: expected {legal}")
