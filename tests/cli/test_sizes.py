"""Sizes of files as people type them."""

import pytest

from compgs.cli.sizes import parse_size
from compgs.cli.usage import UsageError
from compgs.words import size


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("130kB", 130_000),
        ("130 KB", 130_000),
        ("2MB", 2_000_000),
        (".5mb", 500_000),
        ("1.5MiB", 1_572_864),
        ("131072", 131_072),
        ("812 B", 812),
        ("1GB", 1_000_000_000),
    ],
)
def test_a_size_is_read_in_the_unit_it_is_given_in(text: str, count: int) -> None:
    assert parse_size(text, "--target-size") == count


@pytest.mark.parametrize("count", [1, 999, 1200, 131_100, 2_340_000])
def test_a_size_that_is_shown_can_be_typed(count: int) -> None:
    assert parse_size(size(count), "--target-size") == count


@pytest.mark.parametrize(
    "text", ["", "small", "-3kB", "2 Mbit", "1e6", "nan", "0", "0.1 B", "3 kB 4", "2,5MB"]
)
def test_anything_else_is_refused_by_name(text: str) -> None:
    with pytest.raises(UsageError, match="--target-size"):
        parse_size(text, "--target-size")
