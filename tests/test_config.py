import math

import pytest

from compgs.config import PRESETS, Config, config_from_dict, load_config
from compgs.errors import ConfigError


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
        ("training", "color_lr", [-1e-3, 1e-4]),
        ("training", "entropy_lr", [1e-3]),
        ("training", "quantized_weights", math.nan),
        ("training", "checkpoint_minutes", math.nan),
        ("training", "rate", "words"),
        ("training", "left_out", -1.0),
        ("control", "start", math.nan),
        ("control", "growth_probabilities", [0.5, 0.5, 7.0]),
        ("control", "growth_probabilities", [0.5, 0.5]),
        ("control", "start_passes", 0.0),
        ("control", "every_passes", math.nan),
        ("control", "observe_passes", -1.0),
        ("control", "minimum_share", 0.0),
        ("control", "opacity_views", 0),
        ("control", "opacity_share", -0.1),
        ("control", "reset_all", 1.0),
        ("control", "finer_needs_coarser", "yes"),
        ("entropy", "network_blocks", -3),
        ("entropy", "network_blocks", 10**8),
        ("entropy", "network_width", 0),
        ("entropy", "network_width", 10**8),
        ("entropy", "reference_step", 0.0),
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
