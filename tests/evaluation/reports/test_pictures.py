"""Pictures of differences by closed form, and pictures that fit into a page."""

from pathlib import Path

import numpy as np

from compgs.evaluation.reports.pictures import (
    COLORS,
    LEAST_WIDTH,
    difference_picture,
    levels_between,
    read_picture,
    reduced,
    scale_for,
    urls_within,
)

from .parsed_page import picture_of


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def test_levels_are_the_mean_of_the_channels_differences_without_overflow() -> None:
    a = np.array([[[0, 0, 0], [255, 10, 7]]], np.uint8)
    b = np.array([[[255, 255, 255], [0, 20, 7]]], np.uint8)
    np.testing.assert_allclose(levels_between(a, b), [[255.0, 265 / 3]])


def test_a_scale_ends_where_hardly_a_pixel_exceeds_it() -> None:
    levels = np.zeros((100, 100))
    assert scale_for([levels]) == 4
    levels[0] = 9.0  # one pixel in a hundred
    assert scale_for([levels]) == 4
    levels[1, 0] = 9.0
    assert scale_for([levels]) == 16
    assert scale_for([np.zeros((5, 5)), np.full((5, 5), 250.0)]) == 255


def test_differences_are_black_where_there_is_none_and_lighter_the_larger_they_are() -> None:
    picture = difference_picture(np.array([[0.0, 4.0, 8.0, 12.0, 16.0, 99.0]]), 16)
    np.testing.assert_array_equal(picture[0, :5], COLORS)
    np.testing.assert_array_equal(picture[0, 5], COLORS[-1])
    lightness = picture[0, :5].astype(float) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) > 15).all()


def test_small_pictures_stay_as_they_are_and_wide_ones_keep_their_shape() -> None:
    assert reduced(noise(20, 30), 30).shape == (20, 30, 3)
    assert reduced(noise(200, 300), 30).shape == (20, 30, 3)
    assert reduced(noise(1, 300), 30).shape == (1, 30, 3)


def test_pictures_in_a_page_look_as_they_did() -> None:
    gradient = np.broadcast_to(np.arange(200, dtype=np.uint8)[None, :, None], (120, 200, 3)).copy()
    shown = picture_of(urls_within([gradient], 400, 10_000_000)[0])
    assert shown.shape == gradient.shape
    assert np.abs(shown.astype(int) - gradient).max() <= 8


def test_many_pictures_are_reduced_until_they_fit() -> None:
    images = [noise(300, 400, seed) for seed in range(4)]
    whole = sum(map(len, urls_within(images, 400, 10**9)))
    urls = urls_within(images, 4000, whole // 4)
    assert whole // 16 < sum(map(len, urls)) <= whole // 4 + 4 * 30
    assert {picture_of(url).shape for url in urls} == {picture_of(urls[0]).shape}
    least = urls_within(images, 400, 10)
    assert picture_of(least[0]).shape[1] == LEAST_WIDTH


def test_what_is_no_picture_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"nothing of the kind")
    assert read_picture(tmp_path / "a.png") is None and read_picture(tmp_path / "b.png") is None
