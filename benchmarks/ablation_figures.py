"""Figures of the ablations: PSNR over size, curves, and what a bitstream is made of."""

import io
from collections.abc import Sequence
from typing import Any

from ablation_tables import Row, bits_each, curves_of, measured

SIZE = (6.4, 4.0)  # inches
SMALLEST_SHARE = 0.01  # of a file: components below it are drawn together


def check_matplotlib() -> None:
    """Raises SystemExit with the install line, before hours of training."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise SystemExit("the figures need matplotlib: pip install 'compgs[plot]'") from error


def figure(name: str, scene: str, rows: Sequence[Row]) -> bytes:
    """PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    if name == "bitstream":
        canvas, (left, right) = pyplot.subplots(1, 2, figsize=(1.7 * SIZE[0], SIZE[1]), width_ratios=(2, 1))
        draw_components(left, rows)
        draw_bits(right, rows)
    elif name == "curve":
        measures = measured(rows)
        size = (len(measures) * 0.8 * SIZE[0], SIZE[1])
        canvas, panels = pyplot.subplots(1, len(measures), figsize=size)
        for axes, measure in zip(panels, measures, strict=True):
            draw_curves(axes, rows, measure.key)
            label_axes(axes, measure.title, measure.unit)
    else:
        canvas, axes = pyplot.subplots(figsize=SIZE)
        draw_points(axes, rows)
        label_axes(axes, "PSNR", ", dB")
    canvas.suptitle(f"{name}: {scene}", fontsize=11)
    return png(canvas)


def png(canvas: Any, dpi: int = 120) -> bytes:
    """A finished figure, which is closed."""
    from matplotlib import pyplot

    canvas.tight_layout()
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=dpi)
    pyplot.close(canvas)
    return buffer.getvalue()


def draw_points(axes: Any, rows: Sequence[Row]) -> None:
    """A point a variant, with its spread; a variant that has no file is a line across."""
    for row in rows:
        if row.bytes is None:
            axes.axhline(row.psnr, linestyle="--", color="gray", label=row.label)
        else:
            axes.errorbar(
                row.bytes / 1e3,
                row.psnr,
                yerr=row.psnr_spread,
                marker="o",
                capsize=3,
                linestyle="",
                label=row.label,
            )
    sizes = [row.bytes for row in rows if row.bytes]
    if sizes and max(sizes) > 5 * min(sizes):
        logarithmic_sizes(axes)
    axes.legend(fontsize=8)


def label_axes(axes: Any, title: str, unit: str) -> None:
    """Of a chart of quality over size."""
    axes.set_xlabel("file, kB")
    axes.set_ylabel(f"{title} of held-out views{unit}")
    axes.grid(alpha=0.3)


def draw_curves(axes: Any, rows: Sequence[Row], measure: str) -> None:
    """A line a curve, over the logarithm of the size."""
    for name, points in curves_of(rows, measure).items():
        sizes, quality = zip(*sorted(points), strict=True)
        axes.plot([size / 1e3 for size in sizes], quality, marker="o", label=name)
    logarithmic_sizes(axes)
    axes.legend(fontsize=8)


def logarithmic_sizes(axes: Any) -> None:
    """1, 2, 5, 10, 20, ... in plain numbers: labels that neither overlap nor have exponents."""
    from matplotlib import ticker

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(ticker.NullLocator())


def draw_components(axes: Any, rows: Sequence[Row]) -> None:
    """Stacked shares of each file (the upper part of the paper's figure)."""
    names = list(dict.fromkeys(name for row in rows for name in row.components))
    totals = [sum(row.components.values()) for row in rows]
    small = [
        n
        for n in names
        if all(r.components.get(n, 0) < SMALLEST_SHARE * t for r, t in zip(rows, totals, strict=True))
    ]
    parts = {n: [r.components.get(n, 0) for r in rows] for n in names if n not in small}
    if small:
        parts["other"] = [sum(r.components.get(n, 0) for n in small) for r in rows]
    labels = [f"{row.label}\n{total / 1e3:.0f} kB" for row, total in zip(rows, totals, strict=True)]
    left = [0.0] * len(rows)
    for name, counts in parts.items():
        shares = [100 * count / total for count, total in zip(counts, totals, strict=True)]
        axes.barh(labels, shares, left=left, label=name)
        left = [a + b for a, b in zip(left, shares, strict=True)]
    axes.set_xlabel("share of the file, %")
    axes.invert_yaxis()
    axes.legend(fontsize=7, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.18))


def draw_bits(axes: Any, rows: Sequence[Row]) -> None:
    """Bits per anchor primitive and per coupled primitive (the lower part)."""
    both = [bits_each(row) for row in rows]
    places = range(len(rows))
    axes.bar([p - 0.2 for p in places], [b[0] for b in both], 0.4, label="anchor primitive")
    axes.bar([p + 0.2 for p in places], [b[1] for b in both], 0.4, label="coupled primitive")
    axes.set_xticks(list(places), [row.label for row in rows], fontsize=7)
    axes.set_ylabel("bits each")
    axes.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.18))
