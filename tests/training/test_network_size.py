"""Networks as large as their bits are worth."""

from dataclasses import replace

import pytest

from compgs.config import Config
from compgs.training.network_size import head_bits, head_layout, hidden_width, reference_context


def priced(config: Config, lmbda: float, **model: object) -> Config:
    return replace(
        config,
        model=replace(config.model, networks_by_price=True, **model),  # type: ignore[arg-type]
        training=replace(config.training, lmbda=lmbda),
    )


def test_a_hundred_times_the_anchors_at_a_hundred_times_the_lambda_have_the_same_networks() -> None:
    for lmbda in (1e-6, 1e-4, 1e-3, 5e-3, 1e-2, 3e-2, 0.1, 1.0):
        small, large = priced(Config(), lmbda), priced(Config(), 100 * lmbda)
        assert hidden_width(small, 777) == hidden_width(large, 77_700)
        assert head_bits(small, lmbda, 777) == head_bits(large, 100 * lmbda, 77_700)


def test_networks_never_grow_with_the_price_of_a_bit() -> None:
    prices = [1e-12 * 1.3**n for n in range(100)]
    widths = [hidden_width(priced(Config(), 1000 * price), 1000) for price in prices]
    bits = [head_bits(Config(), 1000 * price, 1000) for price in prices]
    assert widths == sorted(widths, reverse=True) and {*widths} == {32, 16, 8}
    assert bits == sorted(bits, reverse=True) and {*bits} == {7, 6, 5}


@pytest.mark.parametrize("lmbda", [0.0, 1e-6, 0.01, 100.0])
def test_narrower_networks_and_fewer_bits_that_were_asked_for_stay(lmbda: float) -> None:
    config = priced(Config(), lmbda, width=8)
    assert hidden_width(config, 10) == 8
    config = replace(config, entropy=replace(config.entropy, head_bits=6))
    assert head_bits(config, lmbda, 10) <= 6


def test_without_it_networks_are_as_the_settings_say_whatever_the_price() -> None:
    config = replace(Config(), model=replace(Config().model, networks_by_price=False))
    config = replace(config, training=replace(config.training, lmbda=100.0))
    assert (hidden_width(config, 1), head_bits(config, 100.0, 1)) == (32, 7)


def test_a_size_that_is_asked_for_decides_whatever_lambda_begins_with() -> None:
    for lmbda in (1e-6, 1.0):
        for size, width in ((2_000, 8), (12_000, 16), (45_000, 16), (100_000, 32)):
            config = priced(Config(), lmbda)
            config = replace(config, training=replace(config.training, target_bytes=size))
            assert hidden_width(config, 5_000) == width


@pytest.mark.parametrize(
    ("views", "steps", "asked", "layout"),
    [
        (100, 4500, {"lmbda": 1e-5}, "separate"),
        (100, 4499, {"lmbda": 1e-5}, "paired"),  # too short
        (100, 4500, {"lmbda": 2e-5}, "paired"),  # bits cost
        (12, 540, {"lmbda": 1e-5}, "separate"),  # few views are soon seen often
        (12, 539, {"lmbda": 1e-5}, "paired"),
        (100, 4500, {"lmbda": 0.002, "target_bytes": 80_000}, "separate"),
        (100, 4500, {"lmbda": 1e-5, "target_bytes": 79_999}, "paired"),
    ],
)
def test_networks_are_separate_at_the_top_of_runs_that_see_their_views_often(
    views: int, steps: int, asked: dict[str, float], layout: str
) -> None:
    training = replace(Config().training, steps=steps, **asked)  # type: ignore[arg-type]
    config = replace(Config(), training=training)
    assert head_layout(config, 2000, views) == layout
    never = replace(config, model=replace(config.model, separate_where_long=0.0))
    assert head_layout(never, 2000, views) == "paired"
    given = replace(never, model=replace(never.model, heads="separate"))
    assert head_layout(given, 2000, views) == "separate"


def test_references_have_a_context_but_in_small_files() -> None:
    for lmbda, large in ((1e-6, True), (1e-3, True), (3e-3, True), (5e-3, False), (0.1, False)):
        config = priced(Config(), lmbda)
        for asked in ("neighbours", "hyperprior", "none"):
            other = replace(config, model=replace(config.model, reference_context=asked))
            assert reference_context(other, 6000) == (asked if large else "none")
        fixed = replace(config, model=replace(config.model, networks_by_price=False))
        assert reference_context(fixed, 6000) == "neighbours"
    for size, context in ((9_000, "none"), (26_000, "none"), (26_001, "neighbours")):
        small = replace(Config(), training=replace(Config().training, target_bytes=size))
        assert reference_context(small, 6000) == context
    narrow = priced(Config(), 1e-6, width=8)
    assert reference_context(narrow, 6000) == "neighbours", "narrow, but not for the price of a bit"
