"""One chart a scene: PSNR and SSIM over the bytes of the file, our presets as curves, plain 3DGS as a point.

    python benchmarks/quality_over_bytes.py docs/results/ablation_curve_fox.json runs/fox_3dgs/results.json \\
        -o docs/results/quality_over_bytes_fox

Reads any number of JSON files: those of `ablation.py` (of which it takes the variants that belong to a curve, and
plain 3DGS), its single records, and the results.json of a `compgs train --method 3dgs`. All must be of the same scene
and the same held-out views. Several seeds of a variant are one point: the mean, with bars of one standard deviation.
Writes NAME.png, and what is drawn as NAME.md and NAME.json.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from ablation_figures import check_matplotlib
from ablation_tables import Record
from quality_over_bytes_figure import PLAIN_3DGS, figure

from compgs.evaluation.results import SCHEMA
from compgs.outputs import write_bytes, write_json

# What two results must share to be in one chart: the scene, and the held-out views and their size.
SAME = ("scene", "views", "width", "height")


@dataclass(frozen=True)
class Point:
    """A variant over its seeds: means, and standard deviations where there are several."""

    curve: str  # the preset, or PLAIN_3DGS
    label: str
    seeds: int
    bytes: float
    bytes_spread: float | None
    psnr: float  # dB
    psnr_spread: float | None
    ssim: float
    ssim_spread: float | None
    steps: int | None  # of the training, where the file says so
    commits: tuple[str, ...]


# reading ------------------------------------------------------------------------------------------------------------


def read_records(path: Path) -> list[Record]:
    """Of a table, a single record, or the results of a run. Raises SystemExit for anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as reason:
        raise SystemExit(f"{path}: cannot be read as JSON ({reason})") from reason
    content = content if isinstance(content, dict) else {}
    if "records" in content:
        return list(content["records"])
    if "results" in content:
        return [content]
    if content.get("schema") == SCHEMA:
        beside = path.with_name("training.json")
        training = json.loads(beside.read_text(encoding="utf-8")) if beside.is_file() else None
        name = path.resolve().parent.name
        return [{"variant": name, "label": name, "training": training, "results": content}]
    raise SystemExit(f"{path}: neither records of ablation.py nor the results.json of a run")


def drawn(records: Sequence[Record]) -> list[Record]:
    """Those that are on a curve, and plain 3DGS; the same file twice counts once."""
    chosen = {record["results"]["sha256"]: record for record in records if curve_of(record)}
    return list(chosen.values())


def curve_of(record: Record) -> str:
    """Empty for what is not in the chart."""
    return PLAIN_3DGS if record["results"].get("splats") is not None else record.get("curve", "")


def check_comparable(records: Sequence[Record]) -> None:
    """Raises SystemExit for no records, or those of several scenes or of other held-out views."""
    if not records:
        raise SystemExit("nothing to draw: no record belongs to a curve, and none is of plain 3DGS")
    first = records[0]["results"]
    for record in records:
        other = {key: record["results"][key] for key in SAME if record["results"][key] != first[key]}
        if other:
            expected = {key: first[key] for key in other}
            raise SystemExit(
                f"{record['results']['file']}: expected {expected} as of {first['file']}, found {other}; "
                "give the files of one scene at one size"
            )


def points_of(records: Sequence[Record]) -> list[Point]:
    """A point a variant and number of steps, by curve in the order in which they first come, and by bytes."""
    groups: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        groups.setdefault((curve_of(record), record["variant"], steps_of(record)), []).append(record)
    curves = list(dict.fromkeys(curve for curve, _, _ in groups))
    points = [point(curve, mine) for (curve, _, _), mine in groups.items()]
    return sorted(points, key=lambda p: (curves.index(p.curve), p.bytes))


def steps_of(record: Record) -> int | None:
    return (record.get("training") or {}).get("steps")


def point(curve: str, records: Sequence[Record]) -> Point:
    """Of one variant's seeds."""
    numbers: dict[str, float | None] = {}
    for key in ("bytes", "psnr", "ssim"):
        values = [record["results"][key] for record in records]
        numbers[key] = fmean(values)
        numbers[f"{key}_spread"] = stdev(values) if len(values) > 1 else None
    commits = tuple(dict.fromkeys(record["commit"] for record in records if "commit" in record))
    label = PLAIN_3DGS if curve == PLAIN_3DGS else records[0]["label"]
    return Point(curve, label, len(records), steps=steps_of(records[0]), commits=commits, **numbers)  # type: ignore[arg-type]


# writing ------------------------------------------------------------------------------------------------------------


def table(points: Sequence[Point]) -> str:
    """Markdown."""

    def spread(value: float | None, digits: int) -> str:
        return "" if value is None else f" ± {value:,.{digits}f}"

    lines = ["| | PSNR (dB) | SSIM | bytes | steps | seeds |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {p.label} | {p.psnr:.2f}{spread(p.psnr_spread, 2)} | {p.ssim:.4f}{spread(p.ssim_spread, 4)} | "
        f"{p.bytes:,.0f}{spread(p.bytes_spread, 0)} | {p.steps or 'unknown'} | {p.seeds} |"
        for p in points
    ]
    return "\n".join(lines)


def report(points: Sequence[Point], results: dict[str, Any], command: str, picture: str) -> str:
    """The Markdown file. `results`: of any of the records, for the scene and its views."""
    commits = ", ".join(dict.fromkeys(commit for p in points for commit in p.commits)) or "unknown"
    return "\n\n".join(
        [
            f"# Quality over bytes: {results['scene']}",
            f"`{command}`",
            f"Decoded files on {results['views']} held-out views, {results['width']} x {results['height']} pixels; "
            f"bytes are those of the whole file, of plain 3DGS those of its .ply; commit {commits}.",
            f"![quality over bytes]({picture})",
            table(points),
            "",
        ]
    )


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", type=Path, nargs="+", metavar="RESULT.json")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="NAME", help="without an ending")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    check_matplotlib()
    records = drawn([record for path in options.files for record in read_records(path)])
    check_comparable(records)
    points = points_of(records)
    results = records[0]["results"]
    given = sys.argv[1:] if arguments is None else arguments
    name = options.output.name
    command = f"python benchmarks/quality_over_bytes.py {shlex.join(given)}"
    text = report(points, results, command, f"{name}.png")
    write_bytes(options.output.with_name(f"{name}.md"), text.encode())
    facts = {key: results[key] for key in SAME}
    write_json(options.output.with_name(f"{name}.json"), {**facts, "points": [asdict(p) for p in points]})
    write_bytes(options.output.with_name(f"{name}.png"), figure(points, results))
    print(text)


if __name__ == "__main__":
    main()
