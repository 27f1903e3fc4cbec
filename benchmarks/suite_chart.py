"""Quality over bytes of all methods of a suite, from the tables that `compgs benchmark` wrote.

    python benchmarks/suite_chart.py out/scene_plush.csv out/scene_fox.csv -o docs/results/methods.png

A column for each table, PSNR above, SSIM below, over the logarithm of the bytes. Methods at several rates are lines; of
this project's, which are what the eye is to go to, the lines are thick. Variants of a method, whose names begin with
the same word, share color and marker, and differ in how the marker is filled. What is below this project's worst is not
drawn.
"""

import argparse
import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ablation_figures import check_matplotlib
from quality_over_bytes_figure import DPI, label_sizes

from compgs.outputs import write_bytes

PANEL = (3.7, 3.5)  # inches
NAMES = 2.0  # inches, of the methods, beside the panels
OURS = "compgs"  # what the names of this project's rows begin with
# Apart in hue for those next to each other in a table, in lightness, too.
COLORS = (
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#8C6D1F",
    "#7B3294",
    "#C51B7D",
    "#4D9221",
    "#2166AC",
    "#B2182B",
)
MARKERS = ("s", "^", "D", "v", "P", "X", "<", ">", "h", "d")

Row = dict[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    check_matplotlib()
    write_bytes(
        options.output,
        figure({path.stem.partition("_")[2] or path.stem: rows_of(path) for path in options.tables}),
    )


def rows_of(table: Path) -> list[Row]:
    """What was measured here."""
    with table.open(newline="") as file:
        return [row for row in csv.DictReader(file) if not row["method"].endswith("(published)")]


def figure(tables: Mapping[str, Sequence[Row]]) -> bytes:
    """PNG of tables by their titles."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    width, height = len(tables) * PANEL[0] + NAMES, 2 * PANEL[1]
    canvas, panels = pyplot.subplots(2, len(tables), figsize=(width, height), squeeze=False)
    names = list(dict.fromkeys(row["method"] for rows in tables.values() for row in rows))
    for column, (title, rows) in enumerate(tables.items()):
        panels[0, column].set_title(title, fontsize=11)
        for panel, measure, label in zip(
            panels[:, column], ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True
        ):
            draw(panel, rows, names, measure, label if column == 0 else "")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    canvas.set_layout_engine("tight", rect=(0, 0, 1 - NAMES / width, 1))
    canvas.legend(handles, labels, loc="center right", fontsize=9, frameon=False)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=DPI)
    pyplot.close(canvas)
    return buffer.getvalue()


def draw(axes: Any, rows: Sequence[Row], names: Sequence[str], measure: str, label: str) -> None:
    """`names`: of all methods of the figure, which look the same in all of its panels."""
    families = list(dict.fromkeys(name.split()[0] for name in names if not name.startswith(OURS)))
    for name in names:
        points = sorted((float(row["bytes"]), float(row[measure])) for row in rows if row["method"] == name)
        ours = name.startswith(OURS)
        family = name.split()[0]
        variant = [other for other in names if other.split()[0] == family].index(name)
        place = variant if ours else families.index(family)
        axes.plot(
            [size for size, _ in points],
            [quality for _, quality in points],
            label=name,
            color=("#0072B2", "#000000")[place % 2] if ours else COLORS[place % len(COLORS)],
            marker="o" if ours else MARKERS[place % len(MARKERS)],
            fillstyle="full" if ours else ("full", "none", "left")[variant % 3],
            linewidth=2.4 if ours else 1.1,
            linestyle="-" if len(points) > 1 else "",
            markersize=6,
        )
    lowest = [float(row[measure]) for row in rows if row["method"].startswith(OURS)]
    if lowest:  # what failed would flatten all else
        highest = max(float(row[measure]) for row in rows)
        axes.set_ylim(min(lowest) - 0.03 * (highest - min(lowest)), highest + 0.03 * (highest - min(lowest)))
    axes.set_xscale("log")
    label_sizes(axes)
    axes.set_xlabel("size of the file", fontsize=10)
    axes.set_ylabel(label, fontsize=10)
    axes.tick_params(labelsize=9)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
