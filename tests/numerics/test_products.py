"""Products in kernels against numpy in float64."""

import numpy as np
import pytest

from compgs.numerics.products import add_product, multiply, padded


def made(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("rows", [0, 1, 3, 4, 5, 8, 11])
@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5, 7, 8, 9, 12, 15, 16, 17, 23, 24, 31, 36, 42])
def test_every_shape_gives_the_product_and_touches_nothing_else(rows: int, columns: int) -> None:
    a, b = made(rows, 9), made(9, columns, seed=1)
    room = np.full((rows + 2, columns), np.float32(7))
    multiply(a, b, room[1:-1])
    np.testing.assert_allclose(room[1:-1], a.astype(np.float64) @ b, atol=1e-5)
    assert (room[[0, -1]] == 7).all()


@pytest.mark.parametrize("rows", [0, 1, 3, 4, 5, 8, 11, 17])
@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5, 7, 8, 9, 12, 15, 16, 17, 23, 24, 31, 36, 42])
def test_a_product_is_added_once_to_what_was_there_and_touches_nothing_else(rows: int, columns: int) -> None:
    a, b, room = made(rows, 9), made(9, columns, seed=1), made(rows + 2, columns, seed=2)
    before = room.copy()
    add_product(a, b, room[1:-1])
    np.testing.assert_allclose(room[1:-1], before[1:-1] + a.astype(np.float64) @ b, atol=1e-5)
    assert np.array_equal(room[[0, -1]], before[[0, -1]])


def test_a_transposed_left_factor_is_read_where_it_is() -> None:
    x, y, out = made(130, 6), made(130, 20, seed=1), np.zeros((6, 20), np.float32)
    add_product(x.T, y, out)
    np.testing.assert_allclose(out, x.T.astype(np.float64) @ y, atol=1e-4)


@pytest.mark.parametrize(("columns", "width"), [(1, 4), (4, 4), (7, 8), (8, 8), (10, 16), (42, 48)])
def test_columns_of_zeros_change_no_bit_of_the_others(columns: int, width: int) -> None:
    a, b = made(11, 9), made(9, columns, seed=1)
    narrow, wide = made(11, columns), made(11, width)
    multiply(a, b, narrow)
    multiply(a, padded(b), wide)
    assert np.array_equal(wide[:, :columns], narrow) and not wide[:, columns:].any()


def test_nothing_summed_is_zero() -> None:
    out = made(5, 6)
    multiply(made(5, 0), made(0, 6), out)
    assert (out == 0).all()


def test_a_row_does_not_depend_on_the_rows_beside_it() -> None:
    a, b, all_rows = made(13, 36), made(36, 39, seed=1), np.empty((13, 39), np.float32)
    multiply(a, b, all_rows)
    for i in range(13):
        alone = np.empty((1, 39), np.float32)
        multiply(a[i : i + 1], b, alone)
        assert np.array_equal(alone[0], all_rows[i])


def test_rows_of_a_larger_array_are_taken_with_their_strides() -> None:
    wide, b, out = made(6, 20), made(8, 10, seed=1), np.empty((6, 10), np.float32)
    multiply(wide[:, 3:11], b, out)
    np.testing.assert_allclose(out, wide[:, 3:11].astype(np.float64) @ b, atol=1e-5)
