"""What the plane sweep computes in its own way, against torch's and NumPy's functions for the same."""

import numpy as np
import pytest
import torch
from torch import nn

from compgs.stereo.fusion import _numbered
from compgs.stereo.plane_sweep import WINDOW, _mean, _mean_of_best_two


@pytest.mark.parametrize(("height", "width"), [(31, 45), (3, 2), (1, 7)])
def test_means_of_windows_are_those_of_pooling_to_the_bit(height: int, width: int) -> None:
    images = torch.from_numpy(np.random.default_rng(0).random((3, height, width), np.float32))
    reach = WINDOW // 2
    rows = nn.functional.avg_pool2d(images[:, None], (1, WINDOW), 1, (0, reach), count_include_pad=False)
    pooled = nn.functional.avg_pool2d(rows, (WINDOW, 1), 1, (reach, 0), count_include_pad=False)
    assert torch.equal(_mean(images), pooled[:, 0])


@pytest.mark.parametrize("neighbours", [2, 3, 4, 6])
def test_of_all_neighbours_the_two_most_alike_count(neighbours: int) -> None:
    likeness = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (neighbours, 3, 8, 9))).float()
    expected = likeness.topk(2, 0).values.mean(0)
    assert torch.equal(_mean_of_best_two(list(likeness)), expected)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_cells_are_numbered_as_unique_rows(count: int) -> None:
    rows = np.random.default_rng(0).integers(-3, 3, (count, 4))
    unique, cell = np.unique(rows, axis=0, return_inverse=True)
    numbers, first = _numbered(list(rows.T))
    np.testing.assert_array_equal(numbers, cell.reshape(-1))
    np.testing.assert_array_equal(rows[first], unique)
