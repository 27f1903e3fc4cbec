"""The course of a training: few points, their means, and the last report as it was."""

import math

import pytest

from compgs.training import History, TrainingStatus
from compgs.training.run.history import MOST_POINTS


def history(psnr: list[float]) -> History:
    """A report every ten steps."""
    found = History()
    for i, value in enumerate(psnr):
        step = 10 * (i + 1)
        found.add(
            TrainingStatus(step, 10 * len(psnr), 1 / step, value, 100 + i, "anchors", 5000 - i, 0.1, None)
        )
    return found


def test_few_reports_are_all_kept() -> None:
    curve = history([10.0, 20.0, 15.0]).curve()
    assert curve == {
        "step": [10, 20, 30],
        "primitives": [100, 101, 102],
        "estimated_bytes": [5000, 4999, 4998],
        "loss": [1 / 10, 1 / 20, 1 / 30],
        "psnr": [10.0, 20.0, 15.0],
    }


def test_of_many_reports_points_are_means_and_end_with_the_last() -> None:
    count = 2 * MOST_POINTS + 1
    curve = history([float(i) for i in range(count)]).curve()
    assert {len(values) for values in curve.values()} == {math.ceil(count / 3)}
    assert curve["step"][-1] == 10 * count and curve["primitives"][-1] == 100 + count - 1
    assert curve["psnr"][-1] == pytest.approx(count - 2) and curve["psnr"][-2] == pytest.approx(count - 5)
    # Every report is in one of them: also those that are left over at the beginning.
    assert curve["step"][0] == 10 * ((count - 1) % 3 + 1)
    assert curve["psnr"][0] == pytest.approx(((count - 1) % 3) / 2)


def test_a_perfect_picture_among_others_does_not_count() -> None:
    curve = history([math.inf, 20.0, 30.0] * MOST_POINTS).curve()
    assert set(curve["psnr"]) == {25.0}
    assert history([math.inf]).curve()["psnr"] == [math.inf]


def test_a_run_that_reported_nothing_has_an_empty_curve() -> None:
    assert set(map(tuple, History().curve().values())) == {()}
