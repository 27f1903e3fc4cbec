"""Where few views look."""

import pytest

from compgs.training.few_views import fewness


def test_fifteen_views_are_few_and_thirty_are_not() -> None:
    assert [fewness(views) for views in (1, 15, 30, 300)] == [1.0, 1.0, 0.0, 0.0]
    assert fewness(24) == pytest.approx(0.4)
