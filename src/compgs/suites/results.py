"""What a suite came to: the paper's tables with published rows beside ours, the report, and the survey's files.

`table.*` depend on the runs' files alone: the same runs give the same bytes, wherever and in whatever order they
ran. Seconds differ from machine to machine and are in `complexity.*`.
"""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from compgs.evaluation.reports import Run, read_runs, report
from compgs.evaluation.reports.summary import ALL_SCENES, PLAIN_3DGS, Point, points_of, scenes
from compgs.evaluation.reports.tables import Column, Table, Value, to_csv, to_latex, to_markdown
from compgs.outputs import write_bytes
from compgs.suites.jobs import Job
from compgs.suites.suite import PublishedRow, Suite

PUBLISHED = " (published)"  # after the name of a method that did not run here
QUALITY = (
    Column("method", "method"),
    Column("rate", "rate"),
    Column("psnr", "PSNR, dB", ".2f"),
    Column("ssim", "SSIM", ".4f"),
    Column("lpips", "LPIPS", ".4f"),
    Column("bytes", "bytes", ",.0f"),
    Column("ratio", "3DGS / bytes", ".1f"),
)
TIMES = (
    Column("method", "method"),
    Column("rate", "rate"),
    Column("train_seconds", "training, s", ",.0f"),
    Column("decode_seconds", "decoding, s", ".3f"),
    Column("frames_per_second", "frames/s", ".1f"),
    Column("primitives", "primitives", ",.0f"),
)
SURVEY_HEAD = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")


def runs_of(jobs: Sequence[Job]) -> tuple[list[Run], tuple[str, ...]]:
    """The runs of finished jobs, by the names that the suite gives them, and what they lack. Raises ReportError."""
    done = sorted((job for job in jobs if job.done), key=lambda job: job.folder.name)
    order = {job.folder: i for i, job in enumerate(jobs)}
    named = []
    notes: list[str] = []
    for job in sorted(done, key=lambda job: order[job.folder]):
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
    written = report(runs, output / "report.html", title=suite.title, overwrite=True)
    return made, [*files, *written.files]


def tables_of(points: Sequence[Point], suite: Suite, notes: Sequence[str] = ()) -> list[Table]:
    """Quality over all scenes with published rows, complexity, and a table for each scene."""
    whole = [point for point in mean_points(points, len(suite.scenes))]
    several = len(suite.scenes) > 1
    result = [
        quality_table("table", suite.title, whole, suite.published, notes),
        Table(
            "complexity",
            f"{suite.title}: complexity",
            TIMES,
            tuple(tuple(_value(row, column.key) for column in TIMES) for row in whole),
        ),
    ]
    if several:
        for scene in scenes(points):
            of_scene = mean_points([p for p in points if p.scene == scene], 1)
            result.append(quality_table(f"scene_{scene}", f"{suite.title}: {scene}", of_scene, (), ()))
    return result


Row = dict[str, Value]


def mean_points(points: Sequence[Point], count: int) -> list[Row]:
    """Means over the scenes, of each method and rate that has all `count` of them, in the order in which they come."""
    groups: dict[tuple[str, str], list[Point]] = {}
    for point in points:
        groups.setdefault((point.method, point.rate), []).append(point)
    plain = {point.scene: point.mean("bytes") for point in points if point.method == PLAIN_3DGS}
    rows = []
    for (method, rate), group in groups.items():
        if len({point.scene for point in group}) < count:
            continue
        row: Row = {"method": method, "rate": rate or None}
        for name in ("psnr", "ssim", "lpips", "bytes", "train_seconds", "decode_seconds", "frames_per_second",
                     "primitives"):  # fmt: skip
            row[name] = _mean([point.mean(name) for point in group])
        size, reference = row["bytes"], _mean([plain.get(point.scene) for point in group])
        row["ratio"] = reference / size if isinstance(size, float) and size and reference else None
        rows.append(row)
    return rows


def quality_table(
    key: str, title: str, rows: Sequence[Row], published: Sequence[PublishedRow], notes: Sequence[str]
) -> Table:
    """Ours, then published rows, whose ratios are to the published 3DGS."""
    found = [tuple(_value(row, column.key) for column in QUALITY) for row in rows]
    plain = [row.bytes for row in published if row.method == PLAIN_3DGS and row.bytes]
    for row in published:
        ratio = plain[0] / row.bytes if plain and row.bytes else None
        found.append(
            (row.method + PUBLISHED, row.rate or None, row.psnr, row.ssim, row.lpips, row.bytes, ratio)
        )
    sources = dict.fromkeys(row.source for row in published)
    more = (f"Published rows, by their own evaluation: {'; '.join(sources)}.",) if published else ()
    return Table(key, title, QUALITY, tuple(found), (*more, *notes)).without_empty_columns()


def survey_file(points: Sequence[Point]) -> str:
    """A scene's results in the layout of the 3DGS compression survey (w-m/3dgs-compression-survey)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(SURVEY_HEAD)
    for point in points:
        name = f"{point.method} {point.rate}".strip()
        values = [point.mean(key) for key in ("psnr", "ssim", "lpips", "bytes", "primitives")]
        writer.writerow([name, *("" if value is None else value for value in values)])
    return text.getvalue()


def _value(row: Row, key: str) -> Value:
    return row.get(key)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


__all__ = [
    "ALL_SCENES",
    "mean_points",
    "quality_table",
    "runs_of",
    "survey_file",
    "tables_of",
    "write_results",
]
