"""The size of moving pictures follows what they take."""

import math

import pytest

from compgs.viewer.pace import LEAST_SHARE, Pace


def settled(pace: Pace, fixed: float, each: float) -> float:
    """The share after 30 pictures that take `fixed` seconds, and `each` more at full size."""
    for _ in range(30):
        pace.took(fixed + each * pace.share**2)
    return pace.share


@pytest.mark.parametrize(("fixed", "each"), [(0.0, 0.4), (0.03, 0.3), (0.05, 0.1), (0.01, 2.0)])
def test_a_picture_becomes_as_large_as_the_time_allows(fixed: float, each: float) -> None:
    share = settled(Pace(0.08), fixed, each)
    expected = math.sqrt((0.08 - fixed) / each)
    assert share == pytest.approx(min(max(expected, LEAST_SHARE), 1.0), rel=0.05)


def test_what_is_quick_stays_full_and_what_is_too_slow_stays_recognizable() -> None:
    assert settled(Pace(0.08), 0.01, 0.02) == 1.0
    assert settled(Pace(0.08), 0.0, 30.0) == LEAST_SHARE
    assert settled(Pace(math.inf), 3.0, 3.0) == 1.0


def test_nothing_becomes_blurred_for_nothing() -> None:
    """Where most of the time does not depend on the size, a smaller picture would not be there sooner."""
    assert settled(Pace(0.08), 0.3, 0.03) == 1.0
    assert settled(Pace(0.08), 0.4, 0.4) == pytest.approx(0.5, rel=0.05)


def test_pictures_of_another_size_are_learned_from() -> None:
    pace = Pace(0.08)
    for _ in range(10):
        pace.took(0.35, share=1.0)  # at rest
        pace.took(0.05 + 0.3 * pace.share**2)
    assert pace.share == pytest.approx(math.sqrt(0.1), rel=0.05)


def test_one_slow_picture_changes_little() -> None:
    pace = Pace(0.08)
    pace.took(100.0)
    assert pace.share == pytest.approx(1 / 1.5)
