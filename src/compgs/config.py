"""Settings: one typed line each, with its range; the comment above says unit, meaning and source.

`Config()` is the `default` preset; a preset file holds only what differs. Schedules are given as fractions of the run,
so that a run of 2 000 steps and one of 30 000 go through the same phases. "Ref." marks values of the authors' released
configuration.
"""

import dataclasses
import math
import tomllib
import types
import typing
from dataclasses import dataclass, field
from importlib import resources
from typing import Annotated, Any, Literal, NamedTuple

from compgs.errors import ConfigError
from compgs.former_settings import without_former

PRESETS = ("default", "paper", "quick")
SHOWN_SETTINGS = 3  # that a repr shows
MOST_COUPLED = 64  # primitives of an anchor that a file can hold
MAX_VIEWPOINTS = 64  # 13 bytes each; more would say nothing new


@dataclass(frozen=True)
class Range:
    """Numbers a setting may have: from `low` (above it, if `above`) to `high` (below it, if `below`)."""

    low: float
    high: float = math.inf
    above: bool = False
    below: bool = False
    multiple: int = 1

    def __contains__(self, value: float) -> bool:
        low = value > self.low if self.above else value >= self.low
        high = value < self.high if self.below or math.isinf(self.high) else value <= self.high
        return low and high and (self.multiple == 1 or value % self.multiple == 0)

    def __str__(self) -> str:
        multiple = f"a multiple of {self.multiple} from " if self.multiple > 1 else ""
        if not self.above and not self.below and self.high < math.inf:
            return f"{multiple}{self.low:.15g} to {self.high:.15g}"
        low = f"above {self.low:.15g}" if self.above else f"{self.low:.15g} or more"
        if self.high == math.inf:
            return low
        return f"{low}, {'below' if self.below else 'up to'} {self.high:.15g}"


Share = Annotated[float, Range(0, 1)]
Positive = Annotated[float, Range(0, above=True)]
LearningRate = Annotated[float, Range(0, 100, above=True, below=True)]
# First and last of a run.
LearningRates = Annotated[tuple[float, float], Range(0, 100, above=True, below=True)]
Shares = Annotated[tuple[float, ...], Range(0, 1)]
# Layouts of the prediction networks.
Heads = Literal["separate", "paired", "shallow"]


class Phases(NamedTuple):
    """Shares of a run at which its phases begin, by name: a value of `training.phases`."""

    warm: float = 0.05
    rate: float = 0.1
    symbols: float = 0.8
    weights: float = 0.8
    mean: float = 0.9


class QuantizationSteps(NamedTuple):
    """Quantization steps by what they are of: a value of `entropy.quantization_steps`."""

    reference: float = 0.33
    residual: float = 0.5
    covariance: float = 0.15


@dataclass(frozen=True)
class ModelConfig:
    """Hybrid primitives and their prediction (Sec. 3.1, 3.2)."""

    # K, the coupled primitives of an anchor (Sec. 3.4: 10, which is slower and no better at the same size)
    coupled_primitives: Annotated[int, Range(1, MOST_COUPLED)] = 5
    # channels of a reference embedding (Sec. 3.4)
    reference_dim: Annotated[int, Range(1, 256)] = 32
    # channels of a residual embedding (Sec. 3.4)
    residual_dim: Annotated[int, Range(1, 64)] = 8
    # true: each anchor has its own K residual embeddings (Sec. 3.1); false: all anchors share K of them
    residuals: bool = False
    # pixels^2 added to the variances of projected splats (3DGS: 0.3), in pictures of the size of the training
    # photographs; the file keeps an angle, for pictures of other sizes
    dilation: Annotated[float, Range(0.01, 10)] = 0.3
    # hidden width of the residual MLPs (Ref.)
    width: Annotated[int, Range(8, 256, multiple=8)] = 32
    # predicts the reference embeddings in the file. neighbours: earlier anchors around an anchor (not in the paper;
    # training estimates the rate with a hyperprior that the file does not hold); hyperprior: Sec. 3.3; none: one mean a
    # channel
    reference_context: Literal["neighbours", "hyperprior", "none"] = "neighbours"
    # earlier symbols of an anchor, or of a coupled primitive, predict its later ones in the file (not in the paper;
    # training pays for each symbol by itself)
    row_context: bool = True
    # separate: four networks (Sec. 3.2); paired: geometry, appearance; shallow: these without residual blocks, which
    # large captures have
    heads: Heads = "paired"
    # world units between neighbouring anchors; none: `voxel_spacings` decides
    voxel_size: Annotated[float | None, Range(0, above=True)] = None
    # size of a voxel, in median distances between neighbouring points, if `voxel_size` is none
    voxel_spacings: Annotated[float, Range(0, 1e6, above=True, below=True)] = 1.5
    # anchors start with the colors of the points, in three channels of their references
    point_colors: bool = True
    # growth stops at this number of anchors
    max_anchors: Annotated[int, Range(1, 1 << 24)] = 1_000_000


@dataclass(frozen=True)
class EntropyConfig:
    """Quantization and rate (Sec. 3.3)."""

    # hyperprior channels of a reference embedding, if it has a hyperprior (Ref.)
    reference_hyper_dim: Annotated[int, Range(1, 64)] = 4
    # quantization steps of reference embeddings (Sec. 3.4: 1, which costs 0.5 dB in short runs), of residual embeddings
    # (Sec. 3.4: 1) and, at the beginning, of the anchors' log scales, whose steps are learned (Sec. 3.4: 0.01, which
    # spends bits that nobody sees)
    quantization_steps: Annotated[tuple[float, float, float], Range(0, 10, above=True, below=True)] = (
        QuantizationSteps()
    )
    # shares of the run at which references are rotated into their principal axes; the last time, channels that carry
    # almost nothing are dropped (not in the paper)
    decorrelate_at: Shares = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
    # false: latents are trained unrounded, as a bound that no file reaches (ablation)
    quantized: bool = True
    # residual blocks of the entropy networks, as wide as `model.width` (two in Sec. 3.4); 0: one linear layer
    network_blocks: Annotated[int, Range(0, 3)] = 0
    # bits of a weight of the entropy networks in the file; the run trains with weights so rounded
    network_bits: Annotated[int, Range(6, 16)] = 10
    # bits of a weight of the prediction heads in the file
    head_bits: Annotated[int, Range(6, 16)] = 7

    @property
    def steps(self) -> QuantizationSteps:
        """The quantization steps by name."""
        return QuantizationSteps(*self.quantization_steps)


@dataclass(frozen=True)
class ControlConfig:
    """Adaptive control of the anchors: growth and pruning (Ref.). `training/structure/control.py` has its schedule."""

    # share of the run before the first control
    start: Share = 0.15
    # share of the run after which no control comes (Ref.)
    stop: Share = 0.5
    # share of the run between two controls, at least one pass over the training views
    every: Annotated[float, Range(0, 1, above=True)] = 0.05
    # mean norm of the 2D gradient, in units of half the image
    gradient_threshold: Annotated[float, Range(0, 1e6, above=True, below=True)] = 1e-4
    # a primitive that was seen less often is not judged (Ref.: more than 40), unless `variant` allows it
    minimum_views: Annotated[int, Range(0, 1 << 31, below=True)] = 20
    # an anchor with less opacity is removed: the sum over its K primitives, averaged over the views
    opacity_threshold: Annotated[float, Range(0, 1e3, below=True)] = 5e-4
    # probabilities of keeping a candidate for a cell of 16, 4, 1 voxels (Ref.: 0.5, 0.75, 0.875)
    growth_probabilities: Annotated[tuple[float, float, float], Range(0, 1)] = (0.5, 0.25, 0.125)
    # way of counting views and passes: ours, that of the authors' release, or of Scaffold-GS
    # (`training/structure/variants.py`)
    variant: Literal["default", "published", "scaffold-gs"] = "default"
    # share of all blending weights in the training views: primitives that together add no more are left out of the
    # file
    idle_share: Annotated[float, Range(0, 1, below=True)] = 0.002
    # shares of the run at which anchors that are not worth their bits are removed
    prune_at: Shares = (0.3, 0.5, 0.6, 0.7)
    # price that pruning puts on a mean squared change of the training views, in units of the loss
    # (`training/structure/pruning.py`)
    prune_worth: Annotated[float, Range(0, 1e9, above=True, below=True)] = 40.0


@dataclass(frozen=True)
class TrainingConfig:
    """Rate-distortion optimization (Sec. 3.4)."""

    # updates of the scene, each after `views_per_step` views; all schedules are shares of the steps (Ref.: 30 000; half
    # of them train a large capture in about an hour on two cores, docs/results/truck.md)
    steps: Annotated[int, Range(1, 10_000_000)] = 15_000
    # views of a step, in all processes together (torchrun). Learning rates are multiplied by its root, and Adam's betas
    # raised to its power (`training/optimizers.py`). Divide `steps` by it to train on as many views in all.
    views_per_step: Annotated[int, Range(1, 1024)] = 1
    seed: Annotated[int, Range(0, (1 << 31) - 1)] = 0
    # rules that may replace these settings (`training/plan.py`, not in the paper): all, none, or "all but NAME, NAME";
    # `compgs train --plan` prints the decisions
    rules: str = "all"
    # weight of the rate, the price of a bit; 0: bits cost nothing
    lmbda: Annotated[float, Range(0, 100)] = 0.002
    # bytes of the file to aim at: lambda begins at its setting and is moved towards this size
    target_bytes: Annotated[int | None, Range(1, 1 << 40)] = None
    # bits: true bits, normalized so that lambda means the same as in the paper; elements: sum over the tensors of mean
    # bits per element (Ref.)
    rate: Literal["bits", "elements"] = "bits"
    # shares of the run at which five phases begin: the heads have come up to their learning rates; the rate joins the
    # loss (Ref.: 3 000 of 30 000 steps); the likelihood sees symbols, not noise (soft then hard); the networks train
    # with the weights of the file; the mean begins that the file holds (not in the paper; 1: no mean)
    phases: Annotated[tuple[float, float, float, float, float], Range(0, 1)] = Phases()
    # w of (1 - w) L1 + w (1 - SSIM) (3DGS: 0.2, which plain 3DGS and what builds on it have here)
    ssim_weight: Share = 0.4
    # weight of the mean product of the primitives' scales, see `losses.scale_unit` (Ref.)
    scale_weight: Annotated[float, Range(0, 1e6, below=True)] = 0.01
    # learning rate of the embeddings at the start and at the end, in quantization steps per training step
    embedding_lr: LearningRates = (0.05, 3e-4)
    # learning rate of the log scales, at the start and at the end (Ref.)
    log_scale_lr: LearningRates = (0.007, 0.007)
    # factor on the published learning rates of the prediction heads (`training/optimizers.py`)
    head_lr: Positive = 1.0
    # course of all these learning rates (Sec. 4.1; Ref.: exponential)
    schedule: Literal["cosine", "exponential"] = "cosine"
    # learning rate of the entropy model, at the start and at the end (Ref.: 2e-4 -> 1e-5); a shorter run of the
    # published `control.variant` raises it
    entropy_lr: LearningRates = (5e-3, 1e-4)
    # true: learn exposure and color of each training photograph, vignetting and response of each lens, for photographs
    # that cameras exposed and balanced by themselves; the file holds none of it (`training/step/photometry.py`)
    exposure: bool = False
    # learn a small turn and shift of each training view's camera, beside the scene; the file holds none of it
    # (`training/step/poses.py`); auto: if the reconstruction's mean error is above a pixel, or the photographs are
    # frames of a video
    poses: Literal["auto", "on", "off"] = "auto"
    # true: leave out parts of training photographs that the scene keeps failing to show, such as people who walk
    # through (`training/step/robust.py`)
    robust: bool = False
    # cameras of training views that the file keeps, at most: one for each 100 anchors, and three at least; 0: none
    viewpoints: Annotated[int, Range(0, MAX_VIEWPOINTS)] = 12

    def learns_poses(self, *, in_doubt: bool) -> bool:
        """Whether poses are learned where they are `in_doubt` or not, unless a plan says otherwise."""
        return self.poses == "on" or (self.poses == "auto" and in_doubt)

    @property
    def borders(self) -> Phases:
        """The phases of the run by name."""
        return Phases(*self.phases)


@dataclass(frozen=True)
class SplatConfig:
    """Plain 3D Gaussian Splatting (`--method 3dgs`; Kerbl et al. 2023), as published.

    Schedules are fractions of its 30 000 steps, with floors for short runs (`training/splats/densification.py`).
    """

    # degree of the spherical harmonics at the end of the run
    harmonics: Annotated[int, Range(0, 3)] = 3
    # share of the run between two degrees (1 000 of 30 000 steps)
    harmonics_every: Share = 1 / 30
    # opacity of the splats that the points become
    initial_opacity: Annotated[float, Range(0, 1, above=True, below=True)] = 0.1
    # learning rate of positions at the start and at the end, in scene extents per step
    position_lr: LearningRates = (1.6e-4, 1.6e-6)
    # learning rate of harmonic coefficients of degree 0
    color_lr: LearningRate = 2.5e-3
    # learning rate of higher degrees: a twentieth
    harmonics_lr: LearningRate = 1.25e-4
    # learning rate of opacities, as logits
    opacity_lr: LearningRate = 0.05
    log_scale_lr: LearningRate = 5e-3
    # learning rate of quaternions
    rotation_lr: LearningRate = 1e-3
    # share of the run before densification starts (500 of 30 000 steps)
    densify_start: Share = 1 / 60
    # share of the run after which densification stops (15 000 of 30 000 steps)
    densify_stop: Share = 0.5
    # share of the run between two densifications (100 of 30 000 steps)
    densify_every: Annotated[float, Range(0, 1, above=True)] = 1 / 300
    # mean norm of the 2D gradient, in units of half the image
    gradient_threshold: Annotated[float, Range(0, 1e6, above=True, below=True)] = 2e-4
    # scene extents: larger splats are split, smaller ones cloned
    split_size: Annotated[float, Range(0, 1e6, above=True, below=True)] = 0.01
    # splats with less opacity are removed
    prune_opacity: Annotated[float, Range(0, 1, below=True)] = 0.005
    # scene extents: larger splats are removed once opacities have been reset
    prune_size: Annotated[float, Range(0, 1e6, above=True, below=True)] = 0.1
    # share of the run between two resets of the opacities (3 000 of 30 000 steps)
    reset_every: Annotated[float, Range(0, 1, above=True)] = 0.1
    # opacity to which a reset lowers larger ones; above `prune_opacity`
    reset_opacity: Annotated[float, Range(0, 1, above=True, below=True)] = 0.01
    # growth stops at this number of splats; the largest published scenes have about as many
    max_splats: Annotated[int, Range(1, 1 << 26)] = 6_000_000


@dataclass(frozen=True)
class Config:
    """All settings of a run."""

    model: ModelConfig = field(default_factory=ModelConfig)
    entropy: EntropyConfig = field(default_factory=EntropyConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    splats: SplatConfig = field(default_factory=SplatConfig)

    def __init_subclass__(cls) -> None:
        cls.__repr__ = Config.__repr__  # type: ignore[method-assign]  # dataclass would give it one of all settings

    def __repr__(self) -> str:
        """The preset that is nearest, and what differs from it."""
        name, differ = min(((name, self._beside(name)) for name in PRESETS), key=lambda each: len(each[1]))
        shown = ", ".join((repr(name), *differ[:SHOWN_SETTINGS]))
        more = len(differ) - SHOWN_SETTINGS
        return f"{type(self).__name__}({shown}{f', and {more} more' if more > 0 else ''})"

    def _beside(self, preset: str) -> list[str]:
        """Return the settings, with their values, that differ from those of a preset."""
        usual = load_config(preset, type(self)).to_dict()
        return [
            f"{section}.{name}={value!r}"
            for section, values in self.to_dict().items()
            for name, value in values.items()
            if value != usual[section][name]
        ]

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def _section(kind: type, values: dict[str, Any], place: str) -> Any:
    hints = typing.get_type_hints(kind)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ConfigError(f"{place}: unknown setting {unknown[0]!r}; known: {', '.join(sorted(hints))}")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def config_from_dict(values: dict[str, Any], place: str = "settings", kind: type[Config] = Config) -> Config:
    """Inverse of `Config.to_dict`, of a Config that may have more sections. Raises ConfigError on unknown names or
    values out of range.
    """
    hints = typing.get_type_hints(kind)
    values = without_former(values, place)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ConfigError(f"{place}: unknown section {unknown[0]!r}; known: {', '.join(hints)}")
    config = kind(**{k: _section(hints[k], v, f"{place}: [{k}]") for k, v in values.items()})
    check_config(config)
    return config


def load_config(preset: str = "default", kind: type[Config] = Config) -> Config:
    """The settings of a preset: `default`, `paper` or `quick`. Raises ConfigError for any other name."""
    if preset not in PRESETS:
        raise ConfigError(f"preset {preset!r} does not exist; there are {', '.join(PRESETS)}")
    file = resources.files("compgs.presets") / f"{preset}.toml"
    return config_from_dict(tomllib.loads(file.read_text(encoding="utf-8")), f"preset {preset}", kind)


def check_config(config: Config) -> None:
    """Raises ConfigError for the first setting that is out of range."""
    for section in dataclasses.fields(config):
        values = getattr(config, section.name)
        for name, hint in typing.get_type_hints(type(values), include_extras=True).items():
            value = getattr(values, name)
            expected = wrong_value(value, hint)
            if expected:
                raise ConfigError(f"{section.name}.{name} = {value!r}: expected {expected}")
    if config.model.point_colors and config.model.reference_dim < 3:
        raise ConfigError(
            f"model.point_colors = True: needs a model.reference_dim of 3 or more, found {config.model.reference_dim}"
        )
    if config.splats.reset_opacity <= config.splats.prune_opacity:
        raise ConfigError(
            f"splats.reset_opacity = {config.splats.reset_opacity}: expected more than "
            f"splats.prune_opacity, {config.splats.prune_opacity}"
        )


def wrong_value(value: Any, hint: Any) -> str:
    """What a setting of this type, perhaps `Annotated` with a Range, was expected to be; empty if it is."""
    allowed: Range | None = None
    if typing.get_origin(hint) is Annotated:
        hint, allowed = typing.get_args(hint)[:2]
    options, origin = typing.get_args(hint), typing.get_origin(hint)
    if origin is Literal:
        return "" if value in options else " or ".join(map(str, options))
    if origin in (types.UnionType, typing.Union):
        if value is None:
            return ""
        hint = next(option for option in options if option is not types.NoneType)
    if hint is str:
        return "" if isinstance(value, str) else "a text"
    if hint is bool:
        return "" if isinstance(value, bool) else "true or false"
    if origin is tuple:
        count = None if options[-1] is Ellipsis else len(options)
        what = (
            f"{'' if count is None else f'{count} '}numbers{'' if allowed is None else f', each {allowed}'}"
        )
        fits = isinstance(value, tuple) and (count is None or len(value) == count)
        return "" if fits and all(_is_number(part, options[0], allowed) for part in value) else what
    return "" if _is_number(value, hint, allowed) else str(allowed)


def _is_number(value: Any, kind: type, allowed: Range | None) -> bool:
    kinds = (int,) if kind is int else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool) and (allowed is None or value in allowed)
