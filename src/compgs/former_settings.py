"""Settings that there were, so that runs of earlier versions can still be opened, and their settings be understood.

Each entry says what became of the setting. A run's config.json, or its checkpoint, that has one with the value that
holds now is read as if it had none; any other value is refused with the entry's sentence.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from compgs.errors import ConfigError


@dataclass(frozen=True)
class Former:
    """What became of a setting."""

    values: tuple[Any, ...]  # with which nothing has changed
    instead: str  # what to do now, for people


def _of_rule(value: float, without: float, rule: str) -> Former:
    """A setting that only a rule read: it is a constant of `compgs.training.plan` now."""
    return Former((value, without), f"it is {value:.3g}, or off: --set training.rules='all but {rule}'")


FORMER = {
    "model.voxel_rate_exponent": _of_rule(1 / 6, 0.0, "coarser_grid"),
    "control.rate_exponent": _of_rule(1 / 3, 0.0, "growth"),
    "control.prune_less": _of_rule(0.5, 0.0, "bit_discount"),
    "training.left_out": _of_rule(0.2, 0.0, "dropout"),
    "training.coarse_until": _of_rule(0.7, 0.0, "coarse_photographs"),
    "training.rate_every": _of_rule(4, 1, "rate_every"),
    "training.sampled_gradients": _of_rule(0.1, 0.0, "sampled_gradients"),
    "training.passed_over": _of_rule(0.03, 0.0, "hidden_anchors"),
}


def without_former(values: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Sections of settings without those that are gone. Raises ConfigError for one whose value would matter."""
    found: dict[str, Any] = {}
    for section, settings in values.items():
        if not isinstance(settings, Mapping):
            found[section] = settings
            continue
        for key, value in settings.items():
            former = FORMER.get(f"{section}.{key}")
            if former is not None and value not in former.values:
                raise ConfigError(
                    f"{place}: [{section}] {key} = {value!r} is no setting any more; {former.instead}"
                )
        found[section] = {key: value for key, value in settings.items() if f"{section}.{key}" not in FORMER}
    return found
