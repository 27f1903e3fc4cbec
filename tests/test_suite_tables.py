"""Tables of a suite: how many times our bytes a method needs for the same quality."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))
import suite_tables

OURS = [
    ("lambda 0.1", 20.0, 0.5, 1_000),
    ("lambda 0.01", 24.0, 0.7, 16_000),
    ("lambda 0.005", 23.0, 0.6, 20_000),
]


def row(method: str, rate: str, psnr: float, ssim: float, size: int) -> dict[str, str]:
    return {
        "method": method, "rate": rate, "psnr": f"{psnr}", "ssim": f"{ssim}", "bytes": f"{size}", "ratio": "1.0",
    }  # fmt: skip


def cells(psnr: float, ssim: float, size: int) -> list[str]:
    """The last two of the row of a method of such quality, beside OURS."""
    rows = [row("compgs default", *ours) for ours in OURS] + [row("other", "", psnr, ssim, size)]
    return [cell.strip() for cell in suite_tables.table(rows).splitlines()[-1].split("|")[-3:-1]]


def test_bytes_are_beside_those_of_the_same_quality_on_lines_over_their_logarithm() -> None:
    assert cells(22.0, 0.55, 8_000) == ["2.0", "4.0"]  # half way: 4 000 bytes; a quarter: 2 000
    assert cells(20.0, 0.7, 160_000) == ["160", "10"]  # at the curve's ends


def test_a_point_that_a_smaller_file_beats_is_not_on_the_curve() -> None:
    assert cells(23.0, 0.6, 8_000) == ["1.0", "2.0"]  # not 0.4, of the point with 20 000 bytes


def test_what_the_curve_does_not_reach_is_called_above_or_below() -> None:
    assert cells(24.1, 0.49, 8_000) == ["above", "below"]


def test_published_rows_are_left_out_and_a_scene_without_ours_has_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene_tree.csv"
    rows = "other,,20,0.5,1000,3\nother (published),,30,0.9,1000,3\n"
    path.write_text(f"method,rate,psnr,ssim,bytes,ratio\n{rows}")
    monkeypatch.setattr(sys, "argv", ["suite_tables", str(path)])
    suite_tables.main()
    printed = capsys.readouterr().out
    assert "## tree" in printed and "published" not in printed
    assert "| other | – | 20.00 | 0.5000 | 1,000 | 3.0 |  |  |" in printed
