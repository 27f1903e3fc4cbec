"""What runs come to: means over seeds, curves over rates, BD-rates, and the tables of a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from compgs.errors import ConfigError
from compgs.evaluation.bd_rate import Curve, bd_rate
from compgs.evaluation.reports.runs import Run
from compgs.evaluation.reports.tables import Column, Spread, Table, Value

PLAIN_3DGS = "3dgs"  # method that sizes are compared with
# Numbers that seeds change; of the others the mean says enough.
WITH_SPREAD = ("psnr", "ssim", "lpips", "lpips_3dgs", "flip", "bytes")
ALL_SCENES = "mean of all scenes"


@dataclass(frozen=True)
class Measure:
    """Is a measure of quality, by which curves are drawn and compared."""

    key: str
    title: str
    form: str
    unit: str = ""
    sign: int = 1  # -1: less is better


MEASURES = (
    Measure("psnr", "PSNR", ".2f", ", dB"),
    Measure("ssim", "SSIM", ".4f"),
    Measure("lpips", "LPIPS", ".4f", sign=-1),
    Measure("flip", "FLIP", ".4f", sign=-1),
)
ALWAYS = ("psnr", "ssim")  # in every evaluation

NAMES = (Column("scene", "scene"), Column("method", "method"), Column("rate", "rate"))
NUMBERS = (
    Column("seeds", "seeds", ".0f"),
    Column("psnr", "PSNR, dB", ".2f"),
    Column("ssim", "SSIM", ".4f"),
    Column("lpips", "LPIPS", ".4f"),
    Column("lpips_3dgs", "LPIPS as 3DGS", ".4f"),
    Column("flip", "FLIP", ".4f"),
    Column("bytes", "bytes", ",.0f"),
    Column("ratio", "3DGS / bytes", ".1f"),
    Column("anchors", "anchors", ",.0f"),
    Column("primitives", "primitives", ",.0f"),
    Column("train_seconds", "training, s", ",.0f"),
    Column("encode_seconds", "encoding, s", ".3f"),
    Column("decode_seconds", "decoding, s", ".3f"),
    Column("frames_per_second", "frames/s", ".1f"),
    Column("degrees_to_training", "to training views, degrees", ".1f"),
)
COLUMNS = {column.key: column for column in (*NAMES, *NUMBERS)}


@dataclass(frozen=True, eq=False)
class Point:
    """One method at one rate on one scene: its runs differ in their seeds only."""

    scene: str
    method: str
    rate: str
    runs: tuple[Run, ...]

    def spread(self, name: str) -> Spread | None:
        """Mean and standard deviation of a number; None if a run does not know it."""
        values = [_number(run, name) for run in self.runs]
        known = [value for value in values if value is not None]
        if len(known) < len(values) or not known:
            return None
        finite = len(known) > 1 and float("inf") not in known
        return Spread(fmean(known), stdev(known) if finite else None)

    def mean(self, name: str) -> float | None:
        found = self.spread(name)
        return None if found is None else found.mean


def _number(run: Run, name: str) -> float | None:
    if name == "primitives":
        return run.value("splats") or run.value("coupled_primitives")
    if name == "train_seconds":
        # Of a run that went on, the seconds are those of its last part.
        return None if run.training.get("resumed") else run.training.get("seconds")
    if name == "encode_seconds":
        return run.training.get(name)
    if name == "frames_per_second":
        seconds = run.value("render_seconds")
        return 1 / seconds if seconds else None
    return run.value(name)


def points_of(runs: Sequence[Run]) -> list[Point]:
    """Group points by scene, then by method, both in the order in which they first come; of a method the smallest files
    first.
    """
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.scene, run.method, run.rate), []).append(run)
    points = [Point(*key, tuple(group)) for key, group in groups.items()]
    places = scenes(runs), methods(runs)
    return sorted(
        points,
        key=lambda p: (places[0].index(p.scene), places[1].index(p.method), p.mean("bytes") or 0.0, p.rate),
    )


def scenes(of: Sequence[Run] | Sequence[Point]) -> list[str]:
    """List the scenes in the order in which they first come."""
    return list(dict.fromkeys(each.scene for each in of))


def methods(of: Sequence[Run] | Sequence[Point]) -> list[str]:
    """List the methods in the order in which they first come."""
    return list(dict.fromkeys(each.method for each in of))


def measured(points: Sequence[Point]) -> tuple[Measure, ...]:
    """PSNR, SSIM, and what else all points know."""
    return tuple(
        m for m in MEASURES if m.key in ALWAYS or all(point.mean(m.key) is not None for point in points)
    )


def means_table(points: Sequence[Point], count: int | None = None) -> Table | None:
    """Means over all scenes, of each method and rate that has them all; None of a single scene.

    `count`: of the scenes, where more are to be there than the points have.
    """
    count = count or len(scenes(points))
    groups: dict[tuple[str, str], list[Point]] = {}
    for point in points:
        groups.setdefault((point.method, point.rate), []).append(point)
    rows = []
    for (method, rate), group in groups.items():
        if len(group) == count > 1:
            numbers = [_row(point, points)[len(NAMES) :] for point in group]
            # Without the scatter over seeds, which is not that over scenes.
            rows.append((method, rate or None, *map(_mean, zip(*numbers, strict=True))))
    columns = (*NAMES[1:], *NUMBERS)
    title = f"Means of {count} scenes"
    return Table("means", title, columns, tuple(rows)).without_empty_columns() if rows else None


def results_table(points: Sequence[Point]) -> Table:
    """A row for each point."""
    rows = tuple(_row(point, points) for point in points)
    several = any(len(point.runs) > 1 for point in points)
    notes = ("± is the standard deviation over the seeds.",) if several else ()
    return Table("results", "Results", (*NAMES, *NUMBERS), rows, notes).without_empty_columns()


def _row(point: Point, points: Sequence[Point]) -> tuple[Value, ...]:
    plain = [p.mean("bytes") for p in points if p.scene == point.scene and p.method == PLAIN_3DGS]
    size = point.mean("bytes")
    ratio = plain[-1] / size if plain and plain[-1] and size else None
    known: dict[str, Value] = {"seeds": len(point.runs), "ratio": ratio}
    for key in (column.key for column in NUMBERS if column.key not in known):
        known[key] = point.spread(key) if key in WITH_SPREAD else point.mean(key)
    numbers = [known[column.key] for column in NUMBERS]
    return (point.scene, point.method, point.rate or None, *numbers)


def _mean(values: Sequence[Value]) -> float | None:
    numbers = [value.mean if isinstance(value, Spread) else value for value in values]
    known = [number for number in numbers if isinstance(number, int | float)]
    return fmean(known) if len(known) == len(numbers) else None


def curve(points: Sequence[Point], scene: str, method: str, measure: str) -> list[tuple[float, float]]:
    """(bytes, quality), means over seeds, ascending by bytes."""
    pairs = [
        (point.mean("bytes"), point.mean(measure))
        for point in points
        if point.scene == scene and point.method == method
    ]
    return sorted((size, quality) for size, quality in pairs if size is not None and quality is not None)


def front(points: Curve) -> list[tuple[float, float]]:
    """The (bytes, quality) points, ascending, of which no smaller file of the curve has the quality."""
    best: list[tuple[float, float]] = []
    for point in sorted(points):
        if not best or point[1] > best[-1][1]:
            best.append(point)
    return best


def bd_rate_table(points: Sequence[Point], reference: str) -> Table | None:
    """BD-rates of every method's curve against the reference's, by every measure; None without two curves.

    Raises ConfigError if no run is of the method `reference`.
    """
    known = methods(points)
    if reference not in known:
        raise ConfigError(f"reference {reference!r}: no run is of that method; there are {', '.join(known)}")
    rows: list[tuple[Value, ...]] = []
    reasons: list[str] = []
    measures = measured(points)
    for scene in scenes(points):
        for method in known:
            # What stands alone is no curve.
            if method == reference or len(curve(points, scene, method, "bytes")) < 2:
                continue
            found: list[float | None] = []
            for measure in measures:
                of_reference, of_method = (
                    [
                        (size, measure.sign * quality)
                        for size, quality in curve(points, scene, name, measure.key)
                    ]
                    for name in (reference, method)
                )
                rate, reason = _bd_rate(of_reference, of_method)
                found.append(rate)
                reasons += [f"{scene}, {method}, {measure.title}: {reason}"] if reason else []
            rows.append((scene, method, *found))
    if not any(value is not None for row in rows for value in row[2:]):
        return None
    rows += _mean_bd_rates(rows)
    columns = (
        Column("scene", "scene"),
        Column("method", "method"),
        *(Column(f"bd_rate_{m.key}", f"by {m.title}", "+.1%") for m in measures),
    )
    notes = (
        f"Change of bytes at equal quality, beside {reference}: less than zero is smaller.",
        *dict.fromkeys(reasons),
    )
    return Table("bd_rates", f"BD-rate beside {reference}", columns, tuple(rows), notes)


def _mean_bd_rates(rows: Sequence[tuple[Value, ...]]) -> list[tuple[Value, ...]]:
    """Average the BD-rates of the methods that have a curve on every scene, if there are several."""
    found = {row[0] for row in rows}
    by_method = {row[1]: [other for other in rows if other[1] == row[1]] for row in rows}
    return [
        (ALL_SCENES, method, *(_mean(values) for values in zip(*(row[2:] for row in mine), strict=True)))
        for method, mine in by_method.items()
        if len(mine) == len(found) > 1
    ]


def _bd_rate(reference: Curve, test: Curve) -> tuple[float | None, str]:
    """And what there is to say about it: why there is none, or which points it leaves out."""
    fronts = front(reference), front(test)
    left_out = len(reference) + len(test) - len(fronts[0]) - len(fronts[1])
    try:
        rate = bd_rate(*fronts)
    except ConfigError as reason:
        return None, str(reason)
    points = "1 point is" if left_out == 1 else f"{left_out} points are"
    return rate, f"{points} left out, of which a smaller file has the quality" if left_out else ""


def components_table(points: Sequence[Point]) -> Table:
    """Bytes by component, means over the seeds: a row for each point and component."""
    columns = (*NAMES, Column("component", "component"), Column("bytes", "bytes", ",.0f"))
    rows = tuple(
        (point.scene, point.method, point.rate or None, name, size)
        for point in points
        for name, size in components(point).items()
    )
    return Table("components", "Bytes by component", columns, rows).without_empty_columns()


def components(point: Point) -> dict[str, float]:
    """Bytes, means over the seeds."""
    parts = [run.results["components"] for run in point.runs]
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: fmean(part.get(name, 0) for part in parts) for name in names}


def views_table(points: Sequence[Point]) -> Table:
    """PSNR, SSIM, LPIPS and FLIP of every view, means over the seeds; of each scene the worst view first."""
    columns = (
        Column("scene", "scene"),
        Column("view", "view"),
        *NAMES[1:],
        Column("psnr", "PSNR, dB", ".2f"),
        Column("ssim", "SSIM", ".4f"),
        Column("lpips", "LPIPS", ".4f"),
        Column("lpips_3dgs", "LPIPS as 3DGS", ".4f"),
        Column("flip", "FLIP", ".4f"),
        Column("degrees_to_training", "to training views, degrees", ".1f"),
    )
    rows: list[tuple[Value, ...]] = []
    for scene in scenes(points):
        mine = [point for point in points if point.scene == scene]
        for view in worst_views(mine):
            for point in mine:
                found = [each for run in point.runs for each in run.per_view if each.get("name") == view]
                if found:
                    values = (fmean(psnr(each) for each in found), fmean(each["ssim"] for each in found))
                    more = (
                        _mean([each.get(key) for each in found])
                        for key in ("lpips", "lpips_3dgs", "flip", "degrees_to_training")
                    )
                    rows.append((scene, view, point.method, point.rate or None, *values, *more))
    return Table("views", "Views", columns, tuple(rows)).without_empty_columns()


def worst_views(points: Sequence[Point]) -> list[str]:
    """Names of the views of a scene, by their mean PSNR over all runs, the lowest first."""
    values: dict[str, list[float]] = {}
    for point in points:
        for run in point.runs:
            for view in run.per_view:
                values.setdefault(str(view["name"]), []).append(psnr(view))
    return sorted(values, key=lambda name: fmean(values[name]))


def psnr(view: Mapping[str, Any]) -> float:
    """dB, of an entry of per_view.json: null there is infinite."""
    found = view["psnr"]
    return float("inf") if found is None else found
