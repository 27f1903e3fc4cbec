"""Shares of an error that is known by closed form, and what is written of them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from compgs.evaluation.error_account import COLUMNS, PARTS, ROWS, ErrorAccount, ErrorSums
from compgs.evaluation.error_sheet import error_sheet

RNG = np.random.default_rng(0)
FAR = np.full((32, 48), 10.0)


def account(*views: tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]) -> ErrorAccount:
    sums = ErrorSums()
    for i, view in enumerate(views):
        sums.add(f"{i}.jpg", *view)
    return sums.account()


def gray(level: int, shape: tuple[int, int] = (32, 48)) -> np.ndarray:
    return np.full((*shape, 3), level, np.uint8)


def test_all_shares_of_an_error_add_up_to_it() -> None:
    views = []
    for _ in range(3):
        a, b = (RNG.integers(0, 256, (33, 47, 3), dtype=np.uint8) for _ in range(2))
        depth = np.where(RNG.random((33, 47)) < 0.1, np.inf, np.exp(RNG.normal(2, 1, (33, 47))))
        views.append((a, b, RNG.random((33, 47)) < 0.7, depth))
    found = account(*views)
    for parts in ([p for row in found.regions for p in row], found.scales, found.distances, found.views):
        assert sum(p.share for p in parts) == pytest.approx(1)
    assert sum(p.pixels for p in found.distances) == pytest.approx(1)
    error = np.concatenate([((a[m].astype(float) - b[m]) / 255).reshape(-1) for a, b, m, _ in views])
    assert found.psnr == pytest.approx(-10 * math.log10(np.square(error).mean()))


def test_an_error_in_one_field_of_the_picture_is_found_there() -> None:
    a, b = gray(100), gray(100)
    b[8:16, 36:48] = 110
    found = account((a, b, None, FAR))
    shares = np.array([[part.share for part in row] for row in found.regions])
    assert (
        shares.shape == (ROWS, COLUMNS)
        and shares[1, 3] == pytest.approx(1)
        and shares.sum() == pytest.approx(1)
    )
    assert found.regions[1][3].psnr == pytest.approx(20 * math.log10(255 / 10))
    assert found.regions[0][0].psnr is None


@pytest.mark.parametrize(("period", "finer_than"), [(1, 2), (2, 4), (4, 8), (8, 16), (48, None)])
def test_stripes_are_found_at_their_own_scale(period: int, finer_than: int | None) -> None:
    stripes = np.where(np.arange(48) // period % 2, 90, 110).astype(np.uint8)
    found = account((gray(100), np.broadcast_to(stripes[None, :, None], (32, 48, 3)), None, FAR))
    assert {p.finer_than: p.share for p in found.scales}[finer_than] == pytest.approx(1)
    for part in found.scales:
        gone = finer_than is not None and (part.finer_than is None or part.finer_than >= finer_than)
        assert part.left == pytest.approx(float(not gone and part.finer_than is not None))


def test_an_error_of_what_is_far_is_found_there_and_background_is_apart() -> None:
    a, b = gray(100), gray(100)
    depth = np.broadcast_to(np.linspace(1, 50, 48)[None], (32, 48)).copy()
    depth[:, 40:] = np.inf
    b[:, 36:40] = 120
    b[:, 44:] = 140
    found = account((a, b, None, depth))
    *shown, background = found.distances
    assert len(shown) == PARTS
    near = [(p.near, p.far) for p in shown]
    assert near == sorted(near, key=lambda pair: pair[0] or 0)
    assert background.near is None and background.pixels == pytest.approx(8 / 48)
    assert background.share == pytest.approx(0.8) and shown[-1].share == pytest.approx(0.2)
    assert shown[0].psnr is None and (shown[-1].far or 0) >= 41


def test_parts_of_distances_have_about_as_many_pixels_each() -> None:
    a = gray(100, (100, 120))
    depth = np.exp(RNG.normal(0, 2, a.shape[:2]))
    for part in account((a, a + 1, None, depth)).distances:
        assert part.pixels == pytest.approx(1 / PARTS, abs=0.03)


def test_what_does_not_count_is_nowhere_in_the_account() -> None:
    a, b = gray(100), gray(100)
    b[:, :24] = 200
    mask = np.ones((32, 48), bool)
    mask[:, :24] = False
    found = account((a, b, mask, FAR), (a, b + 1, mask, FAR))
    assert [view.name for view in found.views] == ["1.jpg", "0.jpg"]
    assert found.views[1].share == 0 and found.views[0].psnr == pytest.approx(20 * math.log10(255))
    assert sum(p.share for row in found.regions for p in row[:2]) == 0
    assert (found.mean_levels[:, :24] == 0).all()


def test_identical_pictures_have_no_error_anywhere() -> None:
    found = account((gray(7), gray(7), None, FAR))
    assert found.psnr is None and {p.share for p in found.scales} == {0.0}
    json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize("shape", [(5, 3), (700, 900)])
def test_the_sheet_shows_pictures_of_any_size(shape: tuple[int, int], tmp_path: Path) -> None:
    a, b = gray(100, shape), gray(100, shape)
    b[: shape[0] // 2] = 140
    depth = np.full(shape, 3.0)
    depth[0] = np.inf
    found = account(*[(a, b, None, depth)] * 8)
    sheet = error_sheet(found, "a very \udce9 name")
    assert sheet.dtype == np.uint8 and sheet.shape[2] == 3
    Image.fromarray(sheet).save(tmp_path / "sheet.png")
    # Half of the picture is in error, and shown brighter than the half that is not.
    kept = found.pictures[0]
    assert kept.levels[0].min() == 40 and kept.levels[-1].max() == 0 and len(found.pictures) == 6
