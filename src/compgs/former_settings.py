"""Settings that there were, so that runs of earlier versions can still be opened, and their settings be understood.

Some have become one with others; some are constants now. A run's config.json, or its checkpoint, is read with what they
say today. Where a constant has another value than the run had, it is refused, and the message says what to do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from compgs.errors import ConfigError


@dataclass(frozen=True)
class Former:
    """What became of a setting."""

    values: tuple[Any, ...] | None  # with which nothing has changed; None: any
    instead: str  # what to do now, for people


def _of_rule(value: float, without: float, rule: str) -> Former:
    """A setting that only a rule read: it is a constant of `compgs.training.plan` now."""
    return Former((value, without), f"it is {value:.3g}, or off: --set training.rules='all but {rule}'")


def _became_rule(value: Any, *rules: str) -> Former:
    """A setting that decided for itself whether it applied: rules do so now, unless they are left out."""
    return Former((value,), f"--set training.rules='all but {', '.join(rules)}' turns it off")


def _of_heads(*value: float) -> Former:
    """A learning rate of the heads: they are constants of `compgs.training.optimizers` now."""
    return Former(
        (value,), f"it is {value[0]:g} to {value[1]:g}; --set training.head_lr=FACTOR changes all heads'"
    )


def _of_phases(name: str) -> Former:
    return Former(None, f"it is the border `{name}` of --set training.phases=WARM,RATE,SYMBOLS,WEIGHTS,MEAN")


def _of_variant() -> Former:
    return Former(None, "--set control.variant= default, published or scaffold-gs decides it")


def _of_steps() -> Former:
    return Former(None, "--set entropy.quantization_steps=REFERENCE,RESIDUAL,COVARIANCE holds it")


FORMER = {
    "model.residuals_where_few": _became_rule(1e-3, "own_residuals_few"),
    "model.residuals_where_many": Former(
        None, "anchors share them where views are many; --set model.residuals=true gives each its own"
    ),
    "model.twice_coupled_where_few": _became_rule(1e-4, "twice_coupled"),
    "model.separate_where_long": Former(
        None, "two networks predict at every lambda; --set model.heads=separate gives four"
    ),
    "model.sharp_where_many": _became_rule(0.002, "sharp"),
    "model.networks_by_price": _became_rule(True, "width_16", "width_8", "no_context", "one_bit_less"),
    "model.voxel_rate_exponent": _of_rule(1 / 6, 0.0, "coarser_grid"),
    "control.rate_exponent": _of_rule(1 / 3, 0.0, "growth"),
    "control.prune_less": _of_rule(0.5, 0.0, "bit_discount"),
    "training.left_out": _of_rule(0.2, 0.0, "dropout"),
    # Until 0.7 of a run when it was a setting. What a run has begun with is in the plan of its checkpoint.
    "training.coarse_until": Former(
        (0.7, 0.4, 0.0), "it is 0.4, or off: --set training.rules='all but coarse_photographs'"
    ),
    "training.rate_every": _of_rule(4, 1, "rate_every"),
    "training.sampled_gradients": Former(None, "all gradients go on"),
    "training.passed_over": _of_rule(0.03, 0.0, "hidden_anchors"),
    "training.translation_lr": _of_heads(2e-3, 2e-5),
    "training.covariance_lr": _of_heads(4e-3, 4e-5),
    "training.opacity_lr": _of_heads(2e-3, 2e-5),
    "training.color_lr": _of_heads(8e-3, 8e-5),
    "training.head_optimizer": Former(("adam",), "Adam moves the heads, too"),
    "training.sparse_adam": Former((False,), "Adam moves all anchors in every step"),
    "training.anchor_memory": Former((1000.0,), "Adam remembers the squared gradients of 1 000 steps"),
    "control.prune_share": Former(
        (), "anchors go that are not worth their bits: --set control.prune_worth=PRICE"
    ),
    "training.checkpoint_minutes": Former(None, "a checkpoint is written every five minutes"),
    "training.head_warm_up": _of_phases("warm"),
    "training.rate_start": _of_phases("rate"),
    "training.hard_rate": _of_phases("symbols"),
    "training.quantized_weights": _of_phases("weights"),
    "training.averaged": _of_phases("mean"),
    "training.appearance_dtype": Former(("float32",), "networks train in float32"),
    "training.entropy_lr_steps": Former(
        None, "it is 30 000 with --set control.variant=published; else --set training.entropy_lr=FIRST,LAST"
    ),
    "entropy.network_width": Former(None, "--set model.width=WIDTH is of the entropy networks, too"),
    "entropy.reference_step": _of_steps(),
    "entropy.residual_step": _of_steps(),
    "entropy.covariance_step": _of_steps(),
}
# Former rules: a run that left one out is what every run is now. What `sampled_gradients` decided has the same name in
# the plan of a run.
FORMER_RULES = ("sampled_gradients", "own_residuals_many", "separate_heads", "two_bits_less")
# The former settings of `training` that `training.phases` holds now, in its order, with their defaults.
PHASES = {
    "head_warm_up": 0.05,
    "rate_start": 0.1,
    "hard_rate": 0.8,
    "quantized_weights": 0.8,
    "averaged": 0.1,
}
# The former settings of `entropy` that `entropy.quantization_steps` holds now, in its order, with their defaults.
STEPS = {"reference_step": 0.33, "residual_step": 0.5, "covariance_step": 0.15}
# What `control.variant` stands for, in the former settings of `control`.
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {
        "start_passes": None,
        "every_passes": None,
        "observe_passes": 0.0,
        "minimum_share": 2.0,
        "opacity_views": 5,
        "opacity_share": 0.1,
        "reset_all": False,
        "finer_needs_coarser": False,
    },
    "published": {
        "start_passes": 5.0,
        "every_passes": 2.0,
        "observe_passes": 3.0,
        "minimum_share": 0.2,
        "opacity_views": 1,
        "opacity_share": 0.0,
        "reset_all": True,
        "finer_needs_coarser": True,
    },
    "scaffold-gs": {
        "start_passes": None,
        "every_passes": None,
        "observe_passes": 0.0,
        "minimum_share": 2.0,
        "opacity_views": 1,
        "opacity_share": 0.8,
        "reset_all": False,
        "finer_needs_coarser": True,
    },
}
FORMER |= {f"control.{name}": _of_variant() for name in VARIANTS["default"]}
OF_ANCHORS = (
    "covariance_lr",
    "opacity_lr",
    "color_lr",
)  # methods with anchors have these in a section of theirs


def without_former(values: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Sections of settings in today's words. Raises ConfigError for a former one whose value would matter."""
    sections = {name: dict(s) if isinstance(s, Mapping) else s for name, s in values.items()}
    control, training, entropy = (sections.get(name) for name in ("control", "training", "entropy"))
    if isinstance(control, dict):
        _name_variant(control, place)
    if isinstance(entropy, dict):
        _gather_steps(entropy)
        _leave_width(entropy, sections.get("model"), place)
    if isinstance(training, dict):
        _leave_rules(training)
        _gather_phases(training)
        _leave_entropy_steps(training, control, place)
        if isinstance(sections.get("anchors"), dict):
            sections["anchors"] |= {name: training.pop(name) for name in OF_ANCHORS if name in training}
    for section, settings in sections.items():
        for key in [*settings] if isinstance(settings, dict) else ():
            former = FORMER.get(f"{section}.{key}")
            if former is None:
                continue
            value = settings.pop(key)
            known = tuple(value) if isinstance(value, list) else value
            if former.values is not None and known not in former.values:
                raise _refused(f"{section}.{key}", value, place)
    return sections


def _refused(name: str, value: Any, place: str) -> ConfigError:
    section, key = name.split(".")
    return ConfigError(
        f"{place}: [{section}] {key} = {value!r} is no setting any more; {FORMER[name].instead}"
    )


def _name_variant(control: dict[str, Any], place: str) -> None:
    """Put the name of a variant of control in the place of what it decides. Raises ConfigError if there is none."""
    said = {name: control.pop(name) for name in VARIANTS["default"] if name in control}
    if not said:
        return
    whole = {**VARIANTS["default"], **said}
    found = next((name for name, variant in VARIANTS.items() if variant == whole), None)
    if found is None:
        raise ConfigError(
            f"{place}: [control] {', '.join(said)} are no settings any more; no control.variant has all these values"
        )
    control.setdefault("variant", found)


def _gather_phases(training: dict[str, Any]) -> None:
    """Make `phases` of the shares of a run that were settings of their own."""
    said = {name: training.pop(name) for name in PHASES if name in training}
    if said:
        *borders, averaged = {**PHASES, **said}.values()
        training.setdefault("phases", [*borders, 1.0 - averaged])


def _leave_rules(training: dict[str, Any]) -> None:
    """Take former rules from those that a run goes without."""
    said, but, names = str(training.get("rules", "")).partition("all but ")
    if not said and but:
        left = [name for name in map(str.strip, names.split(",")) if name not in FORMER_RULES]
        training["rules"] = but + ", ".join(left) if left else "all"


def _gather_steps(entropy: dict[str, Any]) -> None:
    """Make `quantization_steps` of the steps that were settings of their own."""
    said = {name: entropy.pop(name) for name in STEPS if name in entropy}
    if said:
        entropy.setdefault("quantization_steps", [*{**STEPS, **said}.values()])


def _leave_width(entropy: dict[str, Any], model: Any, place: str) -> None:
    """The entropy networks are as wide as the prediction networks. Raises ConfigError where they had hidden layers of
    another width.
    """
    width = entropy.pop("network_width", None)
    of_model = model.get("width", 32) if isinstance(model, Mapping) else 32
    if width not in (None, of_model) and entropy.get("network_blocks", 0) != 0:
        raise _refused("entropy.network_width", width, place)


def _leave_entropy_steps(training: dict[str, Any], control: Any, place: str) -> None:
    """Steps that the entropy model's learning rates are meant for go by the variant of control. Raises ConfigError for
    others, where they would raise these rates.
    """
    meant_for = training.pop("entropy_lr_steps", None)
    variant = control.get("variant", "default") if isinstance(control, Mapping) else "default"
    now, steps = 30_000 if variant == "published" else 0, training.get("steps", 30_000)
    if meant_for is not None and max(meant_for, steps) != max(now, steps):
        raise _refused("training.entropy_lr_steps", meant_for, place)
