"""The arrays between files and models, and what no file may make of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.errors import SplatFileError
from compgs.formats.arrays import check_count, checked, degree_of, logit, normalized, sigmoid
from compgs.tensors.splats import Splats

PLACE = Path("a.spz")


@pytest.mark.parametrize("degree", range(4))
def test_splats_and_arrays_hold_the_same_numbers(made, degree: int) -> None:
    arrays = made(7, degree)
    splats = Splats.of(arrays)
    assert splats.degree == arrays.degree == degree
    again = splats.arrays((1.0, 2.0, 3.0))
    assert again.world_offset == (1.0, 2.0, 3.0)
    for name, tensor in vars(splats).items():
        assert tensor.dtype == torch.float32
        np.testing.assert_array_equal(getattr(again, name), getattr(arrays, name))


def test_a_model_keeps_its_numbers_when_the_arrays_change(made) -> None:
    arrays = made(3)
    splats = Splats.of(arrays)
    arrays.means[:] = 0
    assert splats.means.abs().min() > 0


def test_rows_and_degrees_are_chosen_together(made) -> None:
    arrays = made(5)
    chosen = arrays.rows(np.array([4, 1])).of_degree(1)
    assert len(chosen) == 2 and chosen.degree == 1
    np.testing.assert_array_equal(chosen.rest, arrays.rest[[4, 1], :3])
    np.testing.assert_array_equal(chosen.opacity_logits, arrays.opacity_logits[[4, 1]])


def test_degrees_are_counted_without_the_constant() -> None:
    assert [degree_of(count) for count in (0, 3, 8, 15)] == [0, 1, 2, 3]


def test_opacities_of_zero_and_one_have_finite_logits() -> None:
    logits = logit(np.array([0.0, 0.25, 1.0]))
    assert np.isfinite(logits).all()
    assert logits[1] == pytest.approx(-np.log(3))
    np.testing.assert_allclose(sigmoid(logits), [0, 0.25, 1], atol=2e-6)
    np.testing.assert_array_equal(sigmoid(np.array([-1e4, 1e4])), [0, 1])


def test_long_and_short_quaternions_are_normalized_alike() -> None:
    rows = np.array([[1, 2, 3, 4], [1e-30, 2e-30, 3e-30, 4e-30], [1e30, 2e30, 3e30, 4e30]], np.float32)
    np.testing.assert_allclose(normalized(rows), np.tile(np.array([1, 2, 3, 4]) / 30**0.5, (3, 1)), rtol=1e-6)


def test_more_splats_than_a_file_can_hold_are_refused() -> None:
    check_count(PLACE, 65_536, 100)
    check_count(PLACE, 80_000, 10_000)
    for count, size in ((65_537, 100), (80_001, 10_000), (0, 100)):
        with pytest.raises(SplatFileError, match=r"a\.spz: (promises|holds no splats)"):
            check_count(PLACE, count, size)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", np.nan, "means of splat 2 hold nan"),
        ("rest", np.inf, "rest of splat 2 hold inf"),
        ("opacity_logits", -np.inf, "opacity_logits of splat 2 hold -inf"),
        ("log_scales", 88.5, "log_scales of splat 2 hold 88.5, expected a finite number up to 88"),
        ("quaternions", 0.0, "quaternion of splat 2 is zero"),
    ],
)
def test_numbers_that_nothing_can_be_rendered_from_are_named(
    made, name: str, value: float, message: str
) -> None:
    arrays = made(4)
    assert checked(PLACE, arrays) is arrays
    changed = getattr(arrays, name).copy()
    changed[2] = value
    with pytest.raises(SplatFileError, match=message):
        checked(PLACE, replace(arrays, **{name: changed}))
