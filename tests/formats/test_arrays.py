"""The arrays between files and models, and what no file may make of them."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from compgs.errors import SplatFileError
from compgs.formats.arrays import check_count, degree_of, drawable, joined, logit, normalized, sigmoid
from compgs.model.splats import SplatArrays
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


def with_value(arrays: SplatArrays, name: str, row: int | slice, value: float) -> SplatArrays:
    changed = getattr(arrays, name).copy()
    changed[row] = value
    return replace(arrays, **{name: changed})


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("means", np.nan, "without a position"),
        ("means", np.inf, "without a position"),
        ("rest", np.inf, "without a color"),
        ("dc", np.nan, "without a color"),
        ("opacity_logits", np.nan, "without an opacity"),
        ("log_scales", 88.5, "without a size"),
        ("log_scales", np.nan, "without a size"),
        ("log_scales", np.inf, "without a size"),
        ("quaternions", 0.0, r"without a rotation \(their quaternion is zero\)"),
        ("quaternions", np.inf, r"without a rotation \(not a finite number\)"),
    ],
)
def test_what_nothing_can_be_drawn_from_is_left_out_and_counted(
    made, caplog: pytest.LogCaptureFixture, name: str, value: float, reason: str
) -> None:
    arrays = made(6)
    assert drawable(PLACE, arrays) is arrays
    found = drawable(PLACE, with_value(arrays, name, 2, value))
    for column, expected in arrays.columns.items():
        np.testing.assert_array_equal(found.columns[column], np.delete(expected, 2, axis=0))
    (record,) = caplog.records
    assert re.search(rf"a\.spz: 1 of 6 splats were left out: 1 {reason}.* splat 2\)$", record.getMessage())


def test_a_splat_with_several_faults_is_counted_once(made, caplog: pytest.LogCaptureFixture) -> None:
    arrays = with_value(made(8), "quaternions", slice(0, 2), 0.0)
    arrays = with_value(with_value(arrays, "means", 0, np.nan), "dc", 5, np.nan)
    assert len(drawable(PLACE, arrays)) == 5
    assert "3 of 8 splats were left out: 2 without a rotation" in caplog.text
    assert "1 without a color (not a finite number) (the first is splat 5)" in caplog.text


def test_a_file_most_of_whose_splats_cannot_be_drawn_is_refused_with_the_reasons(made) -> None:
    arrays = with_value(made(6), "quaternions", slice(1, 4), 0.0)
    assert len(drawable(PLACE, arrays)) == 3
    arrays = with_value(arrays, "means", 5, np.nan)
    with pytest.raises(
        SplatFileError, match=r"4 of 6 splats cannot be drawn: 3 without a rotation.*; 1 without"
    ):
        drawable(PLACE, arrays)


def test_infinite_numbers_that_mean_something_are_read(made, caplog: pytest.LogCaptureFixture) -> None:
    arrays = with_value(made(6), "opacity_logits", 1, np.inf)
    arrays = with_value(arrays, "opacity_logits", 2, -np.inf)
    arrays = with_value(arrays, "log_scales", 3, -np.inf)
    arrays = with_value(arrays, "quaternions", 4, 3e-30)
    arrays = with_value(arrays, "quaternions", 5, 2e30)
    before = arrays.each(np.copy)
    found = drawable(PLACE, arrays)
    assert not caplog.records and len(found) == 6
    np.testing.assert_allclose(found.opacities[1:3], [1, 0], atol=1e-6)
    assert all(np.isfinite(column).all() for column in found.columns.values())
    np.testing.assert_allclose(np.exp(found.log_scales[3]), 0, atol=1e-37)
    np.testing.assert_allclose(found.quaternions[4:], 0.5, rtol=1e-6)
    for name, column in before.columns.items():
        np.testing.assert_array_equal(arrays.columns[name], column)


def test_splats_of_several_places_are_joined_in_the_frame_of_the_first(made) -> None:
    near, far = (
        replace(made(3, 0), world_offset=(1e6, 0.0, 0.0)),
        replace(made(2, 2), world_offset=(1e6, 2.0, 0.0)),
    )
    found = joined([near, far])
    assert len(found) == 5 and found.degree == 2 and found.world_offset == (1e6, 0.0, 0.0)
    np.testing.assert_array_equal(found.means[3:], far.means + np.float32([0, 2, 0]))
    np.testing.assert_array_equal(found.rest[:3], 0)
    np.testing.assert_array_equal(found.rest[3:], far.rest)
