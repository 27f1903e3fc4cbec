"""What a suite came to: the paper's tables with published rows beside ours, the report, and the survey's files.

`table.*` depend on the runs' files alone: the same runs give the same bytes, wherever and in whatever order they
ran. Seconds differ from machine to machine and are in `complexity.*`.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from compgs.evaluation.reports import Run, read_runs, report
from compgs.evaluation.reports.summary import (
    COLUMNS,
    PLAIN_3DGS,
    Point,
    means_table,
    points_of,
    results_table,
    scenes,
)
from compgs.evaluation.reports.tables import Table, Value, to_csv, to_latex, to_markdown
from compgs.outputs import write_bytes
from compgs.suites.jobs import Job
from compgs.suites.suite import PublishedRow, Suite

PUBLISHED = " (published)"  # after the name of a method that did not run here
QUALITY = ("method", "rate", "psnr", "ssim", "lpips", "lpips_3dgs", "flip", "bytes", "ratio")
TIMES = (
    "method",
    "rate",
    "train_seconds",
    "encode_seconds",
    "decode_seconds",
    "frames_per_second",
    "primitives",
)
SURVEY_HEAD = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")


def runs_of(jobs: Sequence[Job]) -> tuple[list[Run], tuple[str, ...]]:
    """The runs of finished jobs, by the names that the suite gives them, and what they lack. Raises ReportError."""
    named = []
    notes: list[str] = []
    for job in (job for job in jobs if job.done):
        (run,), lacks = read_runs([job.folder])
        named.append(replace(run, scene=job.scene, method=job.method, rate=job.rate, seed=job.seed))
        notes += [lack for lack in lacks if "training curve" not in lack]
    return named, tuple(dict.fromkeys(notes))


def write_results(
    suite: Suite, jobs: Sequence[Job], output: Path, notes: Iterable[str] = ()
) -> tuple[list[Table], list[Path]]:
    """Writes tables, survey files and report.html of the finished jobs; the tables, and all files.

    Raises OutputError, ReportError where no job is finished.
    """
    runs, lacks = runs_of(jobs)
    points = points_of(runs)
    made = tables_of(points, suite, (*notes, *lacks))
    files = []
    for table in made:
        for suffix, text in (("csv", to_csv(table)), ("md", to_markdown(table)), ("tex", to_latex(table))):
            path = output / f"{table.key}.{suffix}"
            write_bytes(path, text.encode())
            files.append(path)
    if suite.survey:
        for scene in scenes(points):
            path = output / "survey" / suite.survey / f"{scene}.csv"
            write_bytes(path, survey_file([p for p in points if p.scene == scene]).encode())
            files.append(path)
    others = made[:1] if suite.published else []
    written = report(runs, output / "report.html", title=suite.title, others=others, overwrite=True)
    return made, [*files, *written.files]


def tables_of(points: Sequence[Point], suite: Suite, notes: Sequence[str] = ()) -> list[Table]:
    """Quality over all scenes with published rows, complexity, and a table for each scene."""
    several = len(suite.scenes) > 1
    whole = means_table(points, len(suite.scenes)) if several else results_table(points)
    rows = [] if whole is None else whole.records()
    result = [
        quality_table("table", suite.title, rows, suite.published, notes),
        _table("complexity", f"{suite.title}: complexity", TIMES, rows),
    ]
    for scene in scenes(points) if several else ():
        mine = results_table([point for point in points if point.scene == scene])
        result.append(
            _table(f"scene_{scene}", f"{suite.title}: {scene}", QUALITY, mine.records(), mine.notes)
        )
    return [table.without_empty_columns() for table in result]


Row = Mapping[str, Value]


def quality_table(
    key: str, title: str, rows: Sequence[Row], published: Sequence[PublishedRow], notes: Sequence[str]
) -> Table:
    """Ours, then published rows, whose ratios are to the published 3DGS."""
    plain = [row.bytes for row in published if row.method == PLAIN_3DGS and row.bytes]
    theirs: list[Row] = [
        {
            "method": row.method + PUBLISHED,
            "rate": row.rate or None,
            **{name: getattr(row, name) for name in ("psnr", "ssim", "lpips", "lpips_3dgs", "bytes")},
            "ratio": plain[0] / row.bytes if plain and row.bytes else None,
        }
        for row in published
    ]
    sources = dict.fromkeys(row.source for row in published)
    more = (f"Published rows, by their own evaluation: {'; '.join(sources)}.",) if published else ()
    return _table(key, title, QUALITY, [*rows, *theirs], (*more, *notes))


def _table(
    key: str, title: str, columns: Sequence[str], rows: Sequence[Row], notes: Sequence[str] = ()
) -> Table:
    cells = tuple(tuple(row.get(column) for column in columns) for row in rows)
    return Table(key, title, tuple(COLUMNS[column] for column in columns), cells, tuple(notes))


def survey_file(points: Sequence[Point]) -> str:
    """A scene's results in the layout of the 3DGS compression survey (w-m/3dgs-compression-survey).

    Its LPIPS is that of published tables: as the release of 3DGS measures it.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(SURVEY_HEAD)
    for point in points:
        name = f"{point.method} {point.rate}".strip()
        values = [point.mean(key) for key in ("psnr", "ssim", "lpips_3dgs", "bytes", "primitives")]
        writer.writerow([name, *("" if value is None else value for value in values)])
    return text.getvalue()
