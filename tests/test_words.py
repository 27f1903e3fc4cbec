"""What people read of numbers with units."""

import pytest

from compgs.words import duration, short_size, size


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (258_143, "258.1 kB"), (1_240_000, "1.24 MB")],
)
def test_sizes_are_in_powers_of_1000(count: int, text: str) -> None:
    assert size(count) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0053, "5.3 ms"), (1.25, "1.25 s"), (245, "4 min 05 s"), (3599.9, "1 h 00 min"), (7380, "2 h 03 min")],
)
def test_times_have_a_readable_unit(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_sizes_have_three_digits() -> None:
    counts = (812, 20_000, 999_950, 1_540_000, 2.5e9)
    assert [short_size(count) for count in counts] == ["812 B", "20 kB", "1 MB", "1.54 MB", "2.5 GB"]
