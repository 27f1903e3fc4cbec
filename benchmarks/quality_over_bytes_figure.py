"""The chart of `quality_over_bytes.py`: PSNR on the left, SSIM on the right, over the logarithm of the bytes."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ablation_figures import png

from compgs.words import short_size

if TYPE_CHECKING:
    from quality_over_bytes import Point

# Drawn at twice the size at which it is shown: 800 pixels across, with letters of 14.
SIZE = (8.0, 3.7)  # inches
DPI = 200
# Apart for every kind of color vision, in lightness too (Okabe and Ito); the first is what the eye goes to.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
ORDER = ("default", "paper")
PLAIN_3DGS, PLAIN = "3DGS", "#333333"
MARKERS = ("o", "s", "^", "D", "v")
# Room beside the outermost points, in factors of their bytes.
MARGIN = 1.35


def figure(points: Sequence["Point"], results: dict[str, Any]) -> bytes:
    """PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    canvas, panels = pyplot.subplots(1, 2, figsize=SIZE)
    draw(panels[0], points, "psnr", "PSNR, dB")
    draw(panels[1], points, "ssim", "SSIM")
    title = f"{results['scene']}: {results['views']} held-out views, {results['width']} x {results['height']} pixels"
    seeds = max(point.seeds for point in points)
    note = f"; bars: standard deviation over {seeds} seeds" if seeds > 1 else ""
    canvas.suptitle(title + note, fontsize=11)
    return png(canvas, DPI)


def draw(axes: Any, points: Sequence["Point"], measure: str, label: str) -> None:
    """One panel: a line a curve, a point for what stands alone, each with its name beside it."""
    for name, (color, marker) in styles(points).items():
        mine = [point for point in points if point.curve == name]
        axes.errorbar(
            [point.bytes for point in mine],
            [getattr(point, measure) for point in mine],
            xerr=bars(mine, "bytes"),
            yerr=bars(mine, measure),
            color=color,
            marker=marker,
            markersize=5,
            linewidth=1.8,
            capsize=2,
            linestyle="-" if len(mine) > 1 else "",
        )
        if name == PLAIN_3DGS:
            # Where a curve meets it, plain 3DGS is reached.
            axes.axhline(max(getattr(p, measure) for p in mine), color=color, linewidth=0.8, linestyle=":")
        name_beside(axes, mine, measure, name, color)
    # Below the lowest point there must be room for its name.
    axes.margins(y=0.09)
    axes.set_xscale("log")
    sizes = [point.bytes for point in points]
    axes.set_xlim(min(sizes) / MARGIN, max(sizes) * MARGIN)
    label_sizes(axes)
    axes.set_ylabel(label, fontsize=10)
    axes.set_xlabel("size of the file", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def styles(points: Sequence["Point"]) -> dict[str, tuple[str, str]]:
    """Color and marker by curve: the same for a preset in every chart, whatever comes first."""
    names = list(dict.fromkeys(point.curve for point in points))
    curves = [name for name in dict.fromkeys((*ORDER, *names)) if name != PLAIN_3DGS]
    looks = [(COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]) for i in range(len(curves))]
    known = {**dict(zip(curves, looks, strict=True)), PLAIN_3DGS: (PLAIN, "*")}
    return {name: known[name] for name in names}


def bars(points: Sequence["Point"], measure: str) -> list[float] | None:
    """Half lengths: one standard deviation, or none where there is but one seed."""
    spreads = [getattr(point, f"{measure}_spread") for point in points]
    return None if all(spread is None for spread in spreads) else [spread or 0.0 for spread in spreads]


def name_beside(axes: Any, points: Sequence["Point"], measure: str, name: str, color: str) -> None:
    """A curve's name stands right of its smallest file: curves rise, so there is room. A lone point's stands below."""
    smallest = min(points, key=lambda point: point.bytes)
    alone = len(points) == 1
    axes.annotate(
        f"{name}\n{short_size(smallest.bytes)}" if alone else name,
        (smallest.bytes, getattr(smallest, measure)),
        (0, -6) if alone else (7, -1),
        textcoords="offset points",
        color=color,
        fontsize=10,
        fontweight="bold",
        ha="center" if alone else "left",
        va="top",
    )


def label_sizes(axes: Any) -> None:
    """10 kB, 100 kB, 1 MB; 2 and 5 of each, too, unless that are so many that they would touch."""
    from matplotlib import ticker

    low, high = axes.get_xlim()
    decades = math.log10(high / low)
    between = (1.0, 2.0, 5.0) if decades < 1.6 else (1.0, 3.0) if decades < 2.5 else (1.0,)
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=between, numticks=20))
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda size, _: short_size(size)))
    axes.xaxis.set_minor_locator(ticker.NullLocator())
