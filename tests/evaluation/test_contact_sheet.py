"""The contact sheet shows what it was given, where it says."""

import numpy as np

from compgs.evaluation.contact_sheet import CELL_WIDTH, COLUMN_WIDTH, MARGIN, contact_sheet, striped


def flat(height: int, width: int, color: tuple[int, int, int]) -> np.ndarray:
    return np.broadcast_to(np.array(color, np.uint8), (height, width, 3)).copy()


def places(sheet: np.ndarray, color: tuple[int, int, int]) -> tuple[int, int, int, int]:
    """First and last row and column that have a color."""
    rows, columns = np.nonzero((sheet == np.array(color)).all(2))
    return rows.min(), rows.max(), columns.min(), columns.max()


def test_photograph_is_left_of_its_rendering_and_whole() -> None:
    sheet = contact_sheet([(flat(60, 80, (255, 0, 0)), flat(60, 80, (0, 0, 255)), "v", 30.0)], "title")
    top, bottom, left, right = places(sheet, (255, 0, 0))
    assert (bottom - top + 1, right - left + 1) == (60, 80)
    other_top, other_bottom, other_left, other_right = places(sheet, (0, 0, 255))
    assert (other_top, other_bottom) == (top, bottom)
    assert other_left == left + COLUMN_WIDTH + MARGIN
    assert other_right - other_left + 1 == 80


def test_views_of_different_sizes_do_not_overlap() -> None:
    rows = [
        (flat(40, 100, (200, 0, 0)), flat(40, 100, (0, 200, 0)), "landscape", 25.0),
        (flat(120, 30, (0, 0, 200)), flat(120, 30, (0, 200, 200)), "portrait", 26.0),
    ]
    sheet = contact_sheet(rows, "two views")
    for photograph, rendering, _, _ in rows:
        for image in (photograph, rendering):
            top, bottom, left, right = places(sheet, tuple(image[0, 0]))
            assert (bottom - top + 1, right - left + 1) == image.shape[:2]


def test_wide_images_are_reduced() -> None:
    sheet = contact_sheet([(flat(500, 2000, (255, 0, 0)), flat(500, 2000, (0, 0, 255)), "v", 30.0)], "title")
    top, bottom, left, right = places(sheet, (255, 0, 0))
    assert right - left + 1 == CELL_WIDTH
    assert bottom - top + 1 == CELL_WIDTH // 4
    assert sheet.dtype == np.uint8


def test_what_does_not_count_is_striped_and_the_rest_is_as_it_was() -> None:
    image, mask = flat(40, 60, (200, 100, 50)), np.ones((40, 60), dtype=bool)
    mask[10:30, 20:50] = False
    shown = striped(image, mask)
    assert shown.dtype == np.uint8
    np.testing.assert_array_equal(shown[mask], image[mask])
    assert {tuple(color) for color in shown[~mask].tolist()} == {(100, 50, 25), (227, 177, 152)}
    assert striped(image, None) is image
