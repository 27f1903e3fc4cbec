"""The chart of a suite: its rows are drawn, published ones are not."""

import csv
import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("matplotlib")
sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))
import suite_chart

ROWS = [
    ("compgs default", "lambda 0.01", 26.9, 0.86, 24_000),
    ("compgs default", "lambda 0.001", 28.3, 0.90, 57_000),
    ("3dgs", "", 29.05, 0.922, 12_803_042),
]


def chart(
    path: Path, rows: list[tuple[str, str, float, float, int]], monkeypatch: pytest.MonkeyPatch
) -> np.ndarray:
    with (path / "table.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("method", "rate", "psnr", "ssim", "bytes"), *rows])
    monkeypatch.setattr(sys, "argv", ["suite_chart", str(path / "table.csv"), "-o", str(path / "chart.png")])
    suite_chart.main()
    return np.asarray(Image.open(io.BytesIO((path / "chart.png").read_bytes())).convert("RGB"))


def test_every_method_of_a_table_is_drawn_and_published_rows_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = chart(tmp_path, ROWS, monkeypatch)
    assert picture.std() > 10
    published = [*ROWS, ("HAC (published)", "low", 27.6, 0.803, 8_700_000)]
    np.testing.assert_array_equal(chart(tmp_path, published, monkeypatch), picture)
    assert not np.array_equal(chart(tmp_path, [*ROWS, ("spz", "", 28.0, 0.9, 10**6)], monkeypatch), picture)
