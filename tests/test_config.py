import dataclasses
import math
import re
import typing
from dataclasses import asdict, replace
from typing import Annotated, Literal

import pytest

from compgs.config import (
    PRESETS,
    Config,
    Phases,
    QuantizationSteps,
    Range,
    config_from_dict,
    load_config,
    wrong_value,
)
from compgs.errors import ConfigError
from compgs.former_settings import FORMER
from compgs.former_settings import VARIANTS as FORMER_VARIANTS
from compgs.training.plan import RULES
from compgs.training.structure.variants import VARIANTS


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_loads_and_survives_its_dictionary(preset):
    config = load_config(preset)
    assert config_from_dict(config.to_dict()) == config


def test_the_default_preset_is_the_defaults():
    assert load_config("default") == Config()


def test_an_unknown_preset_is_named_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"fast.*default, paper, quick"):
        load_config("fast")


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("training", "lmbda", math.nan),
        ("training", "lmbda", -1.0),
        ("training", "steps", 0),
        ("training", "ssim_weight", 7.0),
        ("training", "embedding_lr", [math.nan, 1e-4]),
        ("training", "head_lr", -1.0),
        ("training", "phases", [0.1, 0.2, 0.3, 0.4]),
        ("training", "phases", [0.1, 0.2, 0.3, 0.4, math.nan]),
        ("control", "variant", "ours"),
        ("training", "entropy_lr", [1e-3]),
        ("training", "rate", "words"),
        ("control", "start", math.nan),
        ("control", "growth_probabilities", [0.5, 0.5, 7.0]),
        ("control", "growth_probabilities", [0.5, 0.5]),
        ("entropy", "network_blocks", -3),
        ("entropy", "network_bits", 10**8),
        ("entropy", "quantization_steps", [0.0, 0.5, 0.15]),
        ("model", "coupled_primitives", 65),
        ("model", "width", 12),
        ("model", "voxel_size", math.inf),
    ],
)
def test_values_out_of_range_are_refused_by_name(section, key, value):
    values = Config().to_dict()
    values[section][key] = value
    with pytest.raises(ConfigError, match=f"{section}.{key}"):
        config_from_dict(values)


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"lambda.*lmbda"):
        config_from_dict({"training": {"lambda": 1}})
    with pytest.raises(ConfigError, match=r"optimizer.*training"):
        config_from_dict({"optimizer": {}})


@pytest.mark.parametrize("section", dataclasses.fields(Config), ids=lambda section: section.name)
def test_every_number_has_a_range_and_its_default_is_in_it(section):
    for name, hint in typing.get_type_hints(section.type, include_extras=True).items():
        plain = typing.get_type_hints(section.type)[name]
        if plain in (bool, str) or typing.get_origin(plain) is typing.Literal or name == "seed":
            continue
        assert typing.get_origin(hint) is typing.Annotated, f"{section.name}.{name} has no range"
        assert isinstance(typing.get_args(hint)[1], Range)


@pytest.mark.parametrize(
    ("limits", "inside", "outside", "words"),
    [
        (Range(0, 1), (0, 0.5, 1), (-0.1, 1.1, math.nan), "0 to 1"),
        (Range(0, above=True), (1e-300, 1e300), (0, -1, math.inf, math.nan), "above 0"),
        (Range(0, 1, below=True), (0, 0.999), (1, -1e-9), "0 or more, below 1"),
        (Range(0, 1, above=True), (0.1, 1), (0, 1.1), "above 0, up to 1"),
        (Range(8, 256, multiple=8), (8, 256), (4, 12, 264), "a multiple of 8 from 8 to 256"),
    ],
)
def test_ranges_hold_what_they_say(limits, inside, outside, words):
    assert all(value in limits for value in inside)
    assert not any(value in limits for value in outside)
    assert str(limits) == words


def test_values_of_another_kind_are_refused_with_what_was_expected():
    for value, hint, expected in (
        (True, Annotated[int, Range(1, 9)], "1 to 9"),
        (1.5, Annotated[int, Range(1, 9)], "1 to 9"),
        ("x", Literal["a", "b"], "a or b"),
        (1, bool, "true or false"),
        ((0.1, 0.2), Annotated[tuple[float, float, float], Range(0, 1)], "3 numbers, each 0 to 1"),
        (0.5, Annotated[tuple[float, ...], Range(0, 1)], "numbers, each 0 to 1"),
    ):
        assert wrong_value(value, hint) == expected
    for value, hint in (
        (None, Annotated[float | None, Range(0, 1)]),
        (3, Annotated[float, Range(0, 9)]),
        ((), Annotated[tuple[float, ...], Range(0, 1)]),
    ):
        assert wrong_value(value, hint) == ""


def test_settings_of_earlier_versions_are_read_where_nothing_has_changed() -> None:
    values = Config().to_dict()
    for name, former in FORMER.items():
        section, key = name.split(".")
        assert key not in values[section]
        for value in former.values or ():
            older = {**values, section: {**values[section], key: value}}
            assert config_from_dict(older) == Config()


def test_shares_of_a_run_that_were_settings_of_their_own_are_its_phases() -> None:
    training = {"rate_start": 0.2, "hard_rate": 1.0, "averaged": 0.25}
    found = config_from_dict({"training": training})
    assert found.training.borders == Phases(warm=0.05, rate=0.2, symbols=1.0, weights=0.8, mean=0.75)


def test_quantization_steps_that_were_settings_of_their_own_are_one() -> None:
    found = config_from_dict({"entropy": {"reference_step": 1.0, "covariance_step": 0.01}})
    assert found.entropy.steps == QuantizationSteps(reference=1.0, residual=0.5, covariance=0.01)
    assert config_from_dict(found.to_dict()) == found


def test_entropy_networks_of_earlier_versions_were_as_wide_as_the_others_or_had_no_hidden_layers() -> None:
    assert config_from_dict({"entropy": {"network_width": 64}}) == Config()
    same = {"model": {"width": 64}, "entropy": {"network_blocks": 2, "network_width": 64}}
    assert config_from_dict(same).entropy.network_blocks == 2
    with pytest.raises(ConfigError, match=r"network_width = 16 is no setting any more; .*model[.]width"):
        config_from_dict({"entropy": {"network_blocks": 2, "network_width": 16}})


@pytest.mark.parametrize(
    ("variant", "steps", "meant_for", "same"),
    [
        ("published", 5_000, 30_000, True),
        ("published", 40_000, 0, True),
        ("published", 5_000, 0, False),
        ("default", 5_000, 0, True),
        ("default", 5_000, 4_000, True),
        ("default", 5_000, 30_000, False),
    ],
)
def test_rates_of_entropy_networks_of_earlier_versions_go_by_the_variant(
    variant: str, steps: int, meant_for: int, same: bool
) -> None:
    values = {"control": {"variant": variant}, "training": {"steps": steps, "entropy_lr_steps": meant_for}}
    if same:
        assert config_from_dict(values).training.steps == steps
    else:
        with pytest.raises(ConfigError, match=r"entropy_lr_steps = .* is no setting any more; .*published"):
            config_from_dict(values)


def test_the_control_of_earlier_versions_is_one_of_the_variants() -> None:
    counted = {name: asdict(replace(variant, entropy_steps=0)) for name, variant in VARIANTS.items()}
    assert counted == {name: {**values, "entropy_steps": 0} for name, values in FORMER_VARIANTS.items()}
    for name, settings in FORMER_VARIANTS.items():
        assert config_from_dict({"control": dict(settings)}).control.variant == name
    with pytest.raises(ConfigError, match=r"no control[.]variant has all these values"):
        config_from_dict({"control": {"opacity_views": 7}})


def test_a_run_that_left_out_a_former_rule_is_read_without_it() -> None:
    for rules, today in (
        ("all but sampled_gradients", "all"),
        ("all but own_residuals_many, dropout", "all but dropout"),
        ("all but sampled_gradients, hidden_anchors", "all but hidden_anchors"),
        ("all but dropout, sampled_gradients", "all but dropout"),
        ("all but separate_heads", "all"),
        ("all but dropout", "all but dropout"),
        ("none", "none"),
    ):
        assert config_from_dict({"training": {"rules": rules}}).training.rules == today


def test_rules_that_former_settings_name_are_there() -> None:
    named = {rule for former in FORMER.values() for rule in re.findall(r"all but ([^']+)'", former.instead)}
    known = {rule.name for rule in RULES}
    assert named and all(set(names.split(", ")) <= known for names in named)


def test_settings_of_earlier_versions_that_would_matter_are_refused_with_what_to_do() -> None:
    for section, key, value in (
        ("training", "rate_every", 8),
        ("training", "color_lr", [1e-3, 1e-4]),
        ("training", "appearance_dtype", "bfloat16"),
        ("training", "head_optimizer", "soap"),
        ("model", "networks_by_price", False),
        ("control", "prune_share", 0.02),
    ):
        values = Config().to_dict()
        values[section][key] = value
        with pytest.raises(ConfigError, match=rf"{key} = .* is no setting any more; "):
            config_from_dict(values, "config.json")
