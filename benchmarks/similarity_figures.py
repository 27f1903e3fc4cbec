"""Figure of the local similarity: how alike splats are, and what is left of each attribute after prediction."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from ablation_figures import png
from similarity_measures import NEIGHBOURS, Measured, Similarity

SIZE = (10.0, 4.0)  # inches
# Blue and gray: apart for every kind of color vision, and in print.
NEIGHBOUR, RANDOM = "#0072B2", "#8C8C8C"
BINS = np.linspace(-1, 1, 101)


def figure(name: str, measured: Measured) -> bytes:
    """PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    canvas, (left, right) = pyplot.subplots(1, 2, figsize=SIZE, width_ratios=(5, 4))
    draw_distribution(left, measured)
    draw_left(right, [row for row in measured.rows if row.left is not None])
    canvas.suptitle(f"How alike neighbouring splats are: {name}, {measured.splats:,} splats", fontsize=13)
    return png(canvas)


def draw_distribution(axes: Any, measured: Measured) -> None:
    """How many splats are how similar to their partners, all attributes together."""
    labels = {
        "neighbours": f"its {NEIGHBOURS} nearest\nneighbours",
        "random": f"{NEIGHBOURS}\nrandom\nsplats",
    }
    for name, color in (("random", RANDOM), ("neighbours", NEIGHBOUR)):
        values = getattr(measured, name)
        shares = 100 * np.histogram(values, BINS)[0] / len(values)
        axes.stairs(shares, BINS, fill=True, color=color, alpha=0.45)
        axes.stairs(shares, BINS, color=color, linewidth=1.2)
        # Beside the slope, at half the height: neighbours to the right, random splats to the left.
        half = np.flatnonzero(shares >= shares.max() / 2)
        to_right = name == "neighbours"
        axes.annotate(
            labels[name],
            (BINS[half[-1] + 1] if to_right else BINS[half[0]], shares.max() / 2),
            (8 if to_right else -8, 4),
            textcoords="offset points",
            color=color if to_right else "#5F5F5F",
            fontsize=11,
            fontweight="bold",
            va="bottom",
            ha="left" if to_right else "right",
        )
    low, high = np.quantile(np.concatenate([measured.neighbours, measured.random]), (0.0005, 0.9995))
    axes.set_xlim(min(low, -0.3) - 0.05, min(high + 0.05, 1))
    axes.set_xlabel("mean cosine similarity of a splat to ...")
    axes.set_ylabel("share of the splats, %")
    _plain(axes)


def draw_left(axes: Any, rows: Sequence[Similarity]) -> None:
    """A bar an attribute; without help from the partners it would reach the line."""
    names = [row.attribute for row in rows]
    shares = [100 * (row.left or 0.0) for row in rows]
    bars = axes.barh(names, shares, color=NEIGHBOUR)
    axes.bar_label(
        bars,
        [f"{share:.0f} %" for share in shares],
        label_type="center",
        color="white",
        fontsize=11,
        fontweight="bold",
    )
    without = 100 * (1 + 1 / NEIGHBOURS)
    axes.axvline(without, color=RANDOM, linestyle="--")
    axes.annotate(
        f"by {NEIGHBOURS} random splats",
        (without, 1),
        (0, 3),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        color="#5F5F5F",
        fontsize=10,
        ha="center",
    )
    axes.invert_yaxis()
    axes.set_xlim(0, max(120, 1.05 * max(shares)))
    axes.set_xlabel(f"variance left after prediction by {NEIGHBOURS} neighbours, %")
    axes.tick_params(axis="y", length=0, labelsize=11)
    _plain(axes)


def _plain(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
