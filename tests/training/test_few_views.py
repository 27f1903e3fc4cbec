"""Where few views look."""

import pytest

from compgs.config import ControlConfig
from compgs.training.few_views import fewness
from compgs.training.target_size import pruned_share


def test_fifteen_views_are_few_and_thirty_are_not() -> None:
    assert [fewness(views) for views in (1, 15, 30, 300)] == [1.0, 1.0, 0.0, 0.0]
    assert fewness(24) == pytest.approx(0.4)


def test_where_views_are_few_a_quarter_is_pruned() -> None:
    control = ControlConfig(prune_share=0.02)
    assert [pruned_share(control, 0.002, few) for few in (0.0, 1.0)] == pytest.approx([0.02, 0.005])
    assert pruned_share(control, 0.016, 1.0) == pytest.approx(0.01)  # twice as much at eight times lambda
