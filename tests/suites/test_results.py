"""Tables of a suite: means by hand, rows of others marked, the same bytes whatever order runs were in."""

import csv
from collections.abc import Callable
from pathlib import Path

import pytest

from compgs.errors import ReportError
from compgs.suites.jobs import Job, jobs_of
from compgs.suites.results import write_results
from compgs.suites.suite import Suite


@pytest.fixture
def finished(suite: Suite, tmp_path: Path, finish: Callable[..., None]) -> list[Job]:
    jobs = jobs_of(suite, tmp_path / "data", tmp_path / "out")
    for job in jobs:
        psnr = (
            {"lambda 0.001": 28.0, "lambda 0.01": 25.0, "": 29.0}[job.rate]
            + (job.scene == "south")
            + 0.5 * job.seed
        )
        size = {"lambda 0.001": 60_000, "lambda 0.01": 20_000, "": 6_000_000}[job.rate] * (
            1 + (job.scene == "south")
        )
        finish(job, psnr, size, seconds=7.0 + job.seed)
    return jobs


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_means_over_scenes_and_seeds_and_ratios_to_3dgs(
    suite: Suite, finished: list[Job], tmp_path: Path
) -> None:
    write_results(suite, finished, tmp_path / "out")
    table = rows(tmp_path / "out" / "table.csv")
    ours = [row for row in table if row["method"] == "compgs default"]
    assert [float(row["psnr"]) for row in ours] == [25.75, 28.75]  # (25 + 25.5 + 26 + 26.5) / 4
    assert [float(row["bytes"]) for row in ours] == [30_000, 90_000]
    assert [float(row["ratio"]) for row in ours] == [pytest.approx(300), pytest.approx(100)]
    published = [row for row in table if row["method"].endswith("(published)")]
    assert [(row["method"], row["rate"], row["ratio"]) for row in published] == [
        ("3dgs (published)", "", "1.0"),
        ("Small one (published)", "low", "100.0"),
    ]
    complexity = rows(tmp_path / "out" / "complexity.csv")
    assert float(complexity[0]["train_seconds"]) == 7.5
    assert float(complexity[0]["encode_seconds"]) == pytest.approx(0.15)


def test_each_scene_has_a_table_and_a_file_in_the_survey_s_layout(
    suite: Suite, finished: list[Job], tmp_path: Path
) -> None:
    write_results(suite, finished, tmp_path / "out")
    south = rows(tmp_path / "out" / "scene_south.csv")
    assert [float(row["psnr"]) for row in south] == [26.25, 29.25, 30.25]
    text = (tmp_path / "out" / "survey" / "Small" / "south.csv").read_text()
    assert text.splitlines()[0] == "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians"
    assert text.splitlines()[1].startswith("compgs default lambda 0.01,26.25,")
    assert (tmp_path / "out" / "report.html").stat().st_size > 1000


def test_the_same_runs_give_the_same_bytes_in_whatever_order_they_are(
    suite: Suite, finished: list[Job], tmp_path: Path
) -> None:
    write_results(suite, finished, tmp_path / "out")
    first = (tmp_path / "out" / "table.md").read_bytes()
    for job in reversed(finished):
        (job.folder / "results.json").touch()
    write_results(suite, finished, tmp_path / "out")
    assert (tmp_path / "out" / "table.md").read_bytes() == first


def test_what_is_not_finished_is_left_out_of_means(suite: Suite, finished: list[Job], tmp_path: Path) -> None:
    gone = [job for job in finished if job.rate == "lambda 0.01" and job.scene == "south"]
    for job in gone:
        (job.folder / "results.json").unlink()
    write_results(suite, finished, tmp_path / "out")
    ours = [row for row in rows(tmp_path / "out" / "table.csv") if row["method"] == "compgs default"]
    assert [row["rate"] for row in ours] == ["lambda 0.001"]  # the other has no mean over both scenes
    assert len(rows(tmp_path / "out" / "scene_south.csv")) == 2


def test_without_a_finished_run_there_is_no_table(suite: Suite, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="no run"):
        write_results(suite, jobs_of(suite, tmp_path, tmp_path), tmp_path)
