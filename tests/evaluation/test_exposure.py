"""The colors of a rendering are fitted to its photograph."""

import numpy as np
import pytest

from compgs.evaluation.exposure import at_exposure, fitted_exposure, with_fitted_colors

RNG = np.random.default_rng(0)
SCENE = RNG.integers(30, 220, (20, 30, 3), dtype=np.uint8)
TRUTH = np.array([[0.8, 0.05, 0.0, 0.02], [0.0, 0.7, 0.1, 0.0], [0.1, 0.0, 0.6, 0.05]])


def test_an_affine_change_of_color_is_found() -> None:
    photograph = at_exposure(SCENE, TRUTH)
    np.testing.assert_allclose(fitted_exposure(SCENE, photograph), TRUTH, atol=0.01)
    assert np.abs(with_fitted_colors(SCENE, photograph).astype(int) - photograph).max() <= 2


def test_masked_pixels_have_no_say() -> None:
    photograph, mask = at_exposure(SCENE, TRUTH), np.ones((20, 30), dtype=bool)
    mask[:8] = False
    photograph[:8] = 255
    np.testing.assert_allclose(fitted_exposure(SCENE, photograph, mask), TRUTH, atol=0.01)


@pytest.mark.parametrize("level", [0, 100, 255])
def test_a_view_of_one_color_is_matched_and_bounded(level: int) -> None:
    rendering, photograph = np.full((8, 8, 3), level, np.uint8), np.full((8, 8, 3), 120, np.uint8)
    exposure = fitted_exposure(rendering, photograph)
    assert np.abs(at_exposure(rendering, exposure).astype(int) - 120).max() <= 1
    assert np.abs(exposure).max() < 2


def test_without_a_pixel_to_fit_to_nothing_changes() -> None:
    nothing = np.zeros((20, 30), dtype=bool)
    np.testing.assert_array_equal(with_fitted_colors(SCENE, SCENE, nothing), SCENE)
