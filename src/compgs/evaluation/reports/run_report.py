"""The report on runs: one page that opens anywhere, and its tables beside it for programs, papers and repositories."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from compgs.errors import OutputError
from compgs.evaluation.reports import charts, page, summary, tables
from compgs.evaluation.reports.run_pictures import SHOWN_VIEWS, pictures_of
from compgs.evaluation.reports.runs import Run, read_runs
from compgs.evaluation.reports.summary import Point
from compgs.evaluation.reports.tables import Table
from compgs.outputs import check_output_file, write_bytes
from compgs.paths import as_path
from compgs.words import short_size

SHOWN_CURVES = 12  # of trainings in one chart
SHOWN_COMPONENTS = 9  # each with a color; the others are one
OTHER = "other"
OPEN_ROWS = 40  # of the table of results; a longer one opens with a click
MOST_ROWS = 1000  # of a table in the page
OVERVIEW = ("means", "results", "bd_rates")  # tables that stand at the top


@dataclass(frozen=True)
class Report:
    """What was written."""

    page: Path
    files: tuple[Path, ...]  # all of them
    tables: tuple[Table, ...]
    runs: int
    scenes: int
    notes: tuple[str, ...]  # what is left out and why, one sentence each


def report(
    runs: Iterable[Run | str | Path] | str | Path,
    output: str | Path,
    *,
    title: str = "Report",
    reference: str | None = None,
    views: int = SHOWN_VIEWS,
    others: Sequence[Table] = (),
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Write a page on runs, and beside it its tables: `NAME.md`, `NAME.tex` and a `NAME_TABLE.csv` for each.

    `runs`: a folder, or several, of trainings (`compgs train`) or evaluations (`compgs evaluate -o`), folders of such
    folders, or runs that are known already. Runs that differ in their seeds only are averaged; those that differ in
    their rate only form a curve. `output`: name of the page, ends in `.html`. `reference`: method that BD-rates are
    taken beside; by default the first that has a curve. `views`: how many of each scene are shown, the worst. `others`:
    further tables, such as published results, that stand behind those of the runs. `progress(done, total)` counts the
    scenes whose pictures are read.

    Raises ReportError if there is nothing to report on, ConfigError for an unknown reference, OutputError.
    """
    path = as_path(output, "output")
    if path.suffix.lower() not in (".html", ".htm"):
        raise OutputError(f"{path}: expected a name that ends in .html")
    given = list(runs) if isinstance(runs, Iterable) and not isinstance(runs, str) else [runs]
    known = [run for run in given if isinstance(run, Run)]
    folders = [as_path(each, "runs", "run") for each in given if not isinstance(each, Run)]
    read, notes = read_runs(folders) if folders or not known else ([], ())
    points = summary.points_of([*known, *read])
    made = [*tables_of(points, reference), *others]
    contents = {file: data for file, data in written_tables(path, made).items()}
    for file in (path, *contents):
        check_output_file(file, overwrite=overwrite)
    figures, more = pictures_of(points, views, progress)
    body = "".join(
        [*_overview(points, made), *_training(points), *figures, *_appendix(made, (*notes, *more), path.stem)]
    )
    for file, data in {**contents, path: page.page(title, body)}.items():
        write_bytes(file, data)
    files = (path, *contents)
    return Report(
        path, files, tuple(made), len(known) + len(read), len(summary.scenes(points)), (*notes, *more)
    )


def tables_of(points: Sequence[Point], reference: str | None = None) -> list[Table]:
    """Means, results, BD-rates, components, views: those that there is something to say in. Raises ConfigError."""
    chosen = reference or _first_curve(points)
    found = [
        summary.means_table(points),
        summary.results_table(points),
        summary.bd_rate_table(points, chosen) if chosen else None,
        summary.components_table(points),
        summary.views_table(points),
    ]
    return [table for table in found if table is not None and table.rows]


def written_tables(path: Path, made: Sequence[Table]) -> dict[Path, bytes]:
    """Files beside a page, and what is in them."""
    files = {path.with_name(f"{path.stem}_{table.key}.csv"): tables.to_csv(table) for table in made}
    files[path.with_suffix(".md")] = "\n".join(tables.to_markdown(table) for table in made)
    files[path.with_suffix(".tex")] = "% needs \\usepackage{booktabs}\n\n" + "\n".join(
        tables.to_latex(table) for table in made
    )
    return {file: text.encode("utf-8", "replace") for file, text in files.items()}


def _first_curve(points: Sequence[Point]) -> str | None:
    """The first method of which a scene has several rates."""
    for point in points:
        if len(summary.curve(points, point.scene, point.method, "psnr")) > 1:
            return point.method
    return None


def _overview(points: Sequence[Point], made: Sequence[Table]) -> list[str]:
    """Results, curves and BD-rates, components."""
    by_key = {table.key: table for table in made}
    parts = [page.heading("Results")]
    if "means" in by_key:
        parts += [page.heading(by_key["means"].title, 3), tables.to_html(by_key["means"])]
    results = tables.to_html(by_key["results"])
    parts += [page.folded("Every scene", results) if len(points) > OPEN_ROWS else results]
    parts.append(page.heading("Quality over bytes"))
    for scene in summary.scenes(points):
        parts += _curves(scene, [point for point in points if point.scene == scene], summary.methods(points))
    if "bd_rates" in by_key:
        parts += [page.heading(by_key["bd_rates"].title, 3), tables.to_html(by_key["bd_rates"])]
    parts.append(page.heading("Bytes by component"))
    names = _largest_components(points)
    for scene in summary.scenes(points):
        parts += _components(scene, [point for point in points if point.scene == scene], names)
    return parts


def _curves(scene: str, points: Sequence[Point], methods: Sequence[str]) -> list[str]:
    """A chart by each measure; a method has one color in all scenes."""
    bytes_axis = charts.Axis("size of the file", log=True, form=short_size)
    panels = []
    series: list[charts.Series] = []
    for measure in summary.measured(points):
        series = [
            charts.Series(
                method,
                tuple(_chart_point(p, measure) for p in points if p.method == method),
                style=methods.index(method),
            )
            for method in dict.fromkeys(point.method for point in points)
        ]
        panels.append(charts.line_chart(series, bytes_axis, charts.Axis(measure.title + measure.unit)))
    return [page.heading(scene, 3), page.side_by_side(panels), charts.legend(series)]


def _chart_point(point: Point, measure: summary.Measure) -> charts.Point:
    size, quality = point.spread("bytes"), point.spread(measure.key)
    assert size is not None and quality is not None
    told = f"{point.rate} {short_size(size.mean)}, {tables.shown(quality, measure.form)}"
    return charts.Point(size.mean, quality.mean, size.deviation, quality.deviation, told.strip())


def _largest_components(points: Sequence[Point]) -> list[str]:
    """Names, by their mean share of a file, the largest first; as many as have a color of their own."""
    totals: dict[str, float] = {}
    for parts in map(summary.components, points):
        for name, count in parts.items():
            totals[name] = totals.get(name, 0) + count / max(sum(parts.values()), 1)
    return sorted(totals, key=lambda name: -totals[name])[:SHOWN_COMPONENTS]


def _components(scene: str, points: Sequence[Point], names: Sequence[str]) -> list[str]:
    """A bar for each point; a component has one color in all scenes."""
    rows = []
    for point in points:
        parts = summary.components(point)
        others = sum(count for name, count in parts.items() if name not in names)
        values = [*(parts.get(name, 0) for name in names), others]
        rows.append((f"{point.method} {point.rate}".strip(), values, short_size(sum(values))))
    shown = [*names, OTHER]
    present = [charts.Series(name, (), i) for i, name in enumerate(shown) if any(row[1][i] for row in rows)]
    return [page.heading(scene, 3), charts.shares_chart(rows, shown), charts.legend(present, squares=True)]


def _training(points: Sequence[Point]) -> list[str]:
    """Curves of the trainings that kept theirs, one run of each point."""
    parts = []
    for scene in summary.scenes(points):
        runs = [
            (point, run)
            for point in points
            if point.scene == scene
            for run in point.runs[:1]
            if run.training.get("curve")
        ]
        if not runs:
            continue
        shown = runs[:SHOWN_CURVES]
        series = {
            measure: [_training_series(i, p, run, measure) for i, (p, run) in enumerate(shown)]
            for measure in ("psnr", "estimated_bytes")
        }
        steps = charts.Axis("steps", form="{:,.0f}".format)
        panels = [
            charts.line_chart(series["psnr"], steps, charts.Axis("PSNR of training views, dB")),
            charts.line_chart(
                series["estimated_bytes"],
                steps,
                charts.Axis("size, as estimated while training", log=True, form=short_size),
            ),
        ]
        parts += [page.heading(scene, 3), page.side_by_side(panels), charts.legend(series["psnr"])]
        if len(runs) > len(shown):
            parts.append(page.paragraph(f"{len(runs) - len(shown)} more are not drawn.", "note"))
    return [page.heading("Training"), *parts] if parts else []


def _training_series(style: int, point: Point, run: Run, measure: str) -> charts.Series:
    curve = run.training["curve"]
    places = zip(curve.get("step", ()), curve.get(measure, ()), strict=False)
    known = tuple(charts.Point(step, value) for step, value in places if value is not None)
    return charts.Series(f"{point.method} {point.rate}".strip(), known, style, marked=False)


def _appendix(made: Sequence[Table], notes: Sequence[str], name: str) -> list[str]:
    """Tables of details, those of others, and what is left out. `name`: of the page, without its ending."""
    parts = [page.heading("In numbers")]
    for table in made:
        if table.key in OVERVIEW:
            continue
        if len(table.rows) > MOST_ROWS:
            parts.append(
                page.paragraph(f"{table.title}: {len(table.rows):,} rows, in {name}_{table.key}.csv.")
            )
        else:
            parts.append(page.folded(table.title, tables.to_html(table)))
    if notes:
        parts.append(page.heading("Notes: what is left out"))
        parts += [page.paragraph(f"{note}.", "note") for note in notes]
    return parts
