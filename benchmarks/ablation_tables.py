"""Tables of the ablations: variants over seeds, components, curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from compgs.errors import ConfigError
from compgs.evaluation.bd_rate import Curve, bd_rate
from compgs.evaluation.reports.summary import MEASURES, Measure, front

COUPLED_COMPONENTS = ("masks", "residual hyperprior", "residual embeddings")
# Files of format version 1 call the log scales "covariance"; records of them are kept in docs/results.
ANCHOR_COMPONENTS = ("positions", "reference hyperprior", "reference embeddings", "log scales", "covariance")

Record = dict[str, Any]  # what `ablation.run_variant` knows of one finished variant and seed


@dataclass(frozen=True)
class Row:
    """A variant over its seeds: means, and the standard deviation where there are several."""

    label: str
    curve: str
    psnr: float
    psnr_spread: float | None
    ssim: float
    lpips: float | None
    flip: float | None
    bytes: float | None  # None: no file holds it
    anchors: float | None
    primitives: float | None  # coupled primitives, or splats of 3DGS
    seconds: float
    components: dict[str, float]  # bytes


def rows_of(records: Sequence[Record]) -> list[Row]:
    """In the order in which the variants first come; a row more for a model evaluated unrounded."""
    rows = []
    for name in dict.fromkeys(record["variant"] for record in records):
        mine = [record for record in records if record["variant"] == name]
        if "unrounded" in mine[0]:
            psnr = [record["unrounded"]["psnr"] for record in mine]
            ssim = fmean(record["unrounded"]["ssim"] for record in mine)
            label = "trained unrounded, never rounded (no file)"
            rows.append(Row(label, "", fmean(psnr), _spread(psnr), ssim, *[None] * 5, _seconds(mine), {}))
        results = [record["results"] for record in mine]
        psnr = [result["psnr"] for result in results]
        components = list(dict.fromkeys(name for result in results for name in result["components"]))
        rows.append(
            Row(
                label=mine[0]["label"],
                curve=mine[0]["curve"],
                psnr=fmean(psnr),
                psnr_spread=_spread(psnr),
                ssim=_mean(results, "ssim"),
                lpips=_mean_or_none(results, "lpips"),
                flip=_mean_or_none(results, "flip"),
                bytes=_mean(results, "bytes"),
                anchors=_mean_or_none(results, "anchors"),
                primitives=_mean_or_none(results, "splats") or _mean_or_none(results, "coupled_primitives"),
                seconds=_seconds(mine),
                components={c: fmean(r["components"].get(c, 0) for r in results) for c in components},
            )
        )
    return rows


def _mean(results: Sequence[Record], key: str) -> float:
    return fmean(result[key] for result in results)


def _mean_or_none(results: Sequence[Record], key: str) -> float | None:
    return None if any(result.get(key) is None for result in results) else _mean(results, key)


def _spread(values: Sequence[float]) -> float | None:
    return stdev(values) if len(values) > 1 else None


def _seconds(records: Sequence[Record]) -> float:
    return fmean(record["seconds"] for record in records)


def paired_differences(records: Sequence[Record]) -> list[str]:
    """PSNR of each variant minus that of the first with the same seed: mean and spread over the seeds."""

    def psnr(name: str, key: str) -> dict[int, float]:
        return {r["seed"]: r[key]["psnr"] for r in records if r["variant"] == name and key in r}

    first, *others = dict.fromkeys(record["variant"] for record in records)
    reference = psnr(first, "results")
    lines = []
    for name in others:
        for key, note in (("unrounded", " (never rounded)"), ("results", "")):
            theirs = psnr(name, key)
            differences = [theirs[seed] - reference[seed] for seed in reference if seed in theirs]
            if not differences:
                continue
            spread = _spread(differences)
            over = f" ± {spread:.2f}" if spread is not None else ""
            lines.append(
                f"{name}{note} minus {first}, same seeds: {fmean(differences):+.2f}{over} dB over {len(differences)}"
            )
    return lines


def table(rows: Sequence[Row]) -> str:
    """Markdown."""
    more = [name for name in ("lpips", "flip") if any(getattr(row, name) is not None for row in rows)]
    head = [
        "",
        "PSNR (dB)",
        "SSIM",
        *map(str.upper, more),
        "bytes",
        "anchors",
        "primitives",
        "s",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        spread = f" ± {row.psnr_spread:.2f}" if row.psnr_spread is not None else ""
        others = [getattr(row, name) for name in more]
        counts = [row.bytes, row.anchors, row.primitives]
        cells = [row.label, f"{row.psnr:.2f}{spread}", f"{row.ssim:.4f}"]
        cells += ["" if value is None else f"{value:.4f}" for value in others]
        cells += ["none" if c is None else f"{c:,.0f}" for c in counts]
        lines.append("| " + " | ".join([*cells, f"{row.seconds:.0f}"]) + " |")
    return "\n".join(lines)


def component_table(rows: Sequence[Row]) -> str:
    """Markdown: bytes of each component, and bits per anchor and per coupled primitive (paper, bitstream analysis)."""
    names = list(dict.fromkeys(name for row in rows for name in row.components))
    lines = ["| component | " + " | ".join(row.label for row in rows) + " |", "|---|" + "---|" * len(rows)]
    lines += [
        f"| {name} | " + " | ".join(f"{row.components.get(name, 0):,.0f}" for row in rows) + " |"
        for name in names
    ]
    for name, pick in (("bits per anchor primitive", 0), ("bits per coupled primitive", 1)):
        lines.append(f"| {name} | " + " | ".join(f"{bits_each(row)[pick]:.1f}" for row in rows) + " |")
    return "\n".join(lines)


def bits_each(row: Row) -> tuple[float, float]:
    """Bits per anchor primitive and per coupled primitive, of their own components; networks belong to neither."""
    anchor = 8 * sum(row.components.get(name, 0) for name in ANCHOR_COMPONENTS)
    coupled = 8 * sum(row.components.get(name, 0) for name in COUPLED_COMPONENTS)
    return anchor / max(row.anchors or 0, 1), coupled / max(row.primitives or 0, 1)


def measured(rows: Sequence[Row]) -> list[Measure]:
    """Those that all points of curves know."""
    return [m for m in MEASURES if all(getattr(row, m.key) is not None for row in rows if row.curve)]


def curves_of(rows: Sequence[Row], measure: str) -> dict[str, list[tuple[float, float]]]:
    """(bytes, quality) of each curve."""
    return {
        curve: [(row.bytes, getattr(row, measure)) for row in rows if row.curve == curve and row.bytes]
        for curve in dict.fromkeys(row.curve for row in rows if row.curve)
    }


def compare_curves(rows: Sequence[Row]) -> list[str]:
    """BD-rates of every curve against the first, and on which curves more bytes are not always better."""
    lines = []
    for measure in measured(rows):
        title = measure.title
        curves = {
            name: [(size, measure.sign * quality) for size, quality in curve]
            for name, curve in curves_of(rows, measure.key).items()
        }
        first, *others = curves
        for name, curve in curves.items():
            if front(curve) != sorted(curve):
                lines.append(f"{name}: {title} is not always better with more bytes")
        for name in others:
            lines.append(
                f"BD-rate of {name} against {first} by {title}: {described(curves[first], curves[name])}"
            )
            fronts = front(curves[first]), front(curves[name])
            if fronts != (sorted(curves[first]), sorted(curves[name])):
                kept = f"{len(fronts[0])} of {len(curves[first])} and {len(fronts[1])} of {len(curves[name])} points"
                lines.append(
                    f"the same without points that a smaller file of the curve beats ({kept}): {described(*fronts)}"
                )
    return lines


def described(reference: Curve, test: Curve) -> str:
    """The BD-rate, or why there is none."""
    try:
        return f"{100 * bd_rate(reference, test):+.1f} %"
    except ConfigError as reason:
        return f"none ({reason})"


def report(name: str, scene: str, records: Sequence[Record], command: str) -> str:
    """The Markdown file."""
    rows = rows_of(records)
    first = records[0]
    m, r = first["machine"], first["results"]
    commits = ", ".join(dict.fromkeys(record["commit"] for record in records))
    seeds = ", ".join(str(seed) for seed in dict.fromkeys(record["seed"] for record in records))
    steps = ", ".join(dict.fromkeys(str((record["training"] or {}).get("steps", "?")) for record in records))
    parts = [
        f"# Ablation: {name} on {scene}",
        f"`{command}`",
        f"Decoded files on {r['views']} held-out views, {r['width']} x {r['height']} pixels; {steps} steps; seeds "
        f"{seeds}; commit {commits}; {m['processor']}, {m['cores']} cores, {r['threads']} threads. Seconds are of the "
        "whole command, on a machine that may have had other work.",
        table(rows),
    ]
    if name == "bitstream":
        parts.append(component_table(rows))
    notes = paired_differences(records) if name == "quantization" else []
    notes += compare_curves(rows) if name == "curve" else []
    parts += ["\n".join(f"- {note}" for note in notes)] if notes else []
    parts.append(f"![{name}](ablation_{name}_{scene}.png)")
    return "\n\n".join(parts) + "\n"
