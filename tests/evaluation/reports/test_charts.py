"""Charts put points where their numbers are, and say so in words."""

import itertools
import math
import re

import pytest

from compgs.evaluation.reports.charts import (
    BOTTOM,
    HEIGHT,
    LEFT,
    PALETTE,
    RIGHT,
    TOP,
    WIDTH,
    Axis,
    Point,
    Series,
    legend,
    line_chart,
    shares_chart,
)
from compgs.words import short_size


def circles(svg: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', svg)]


def ticks(svg: str, anchor: str) -> dict[str, float]:
    """Places of the labels along an axis."""
    which = "x" if anchor == "middle" else "y"
    found = re.findall(rf'<text x="([\d.]+)" y="([\d.]+)" text-anchor="{anchor}">([^<]*)<', svg)
    return {label: float(x if which == "x" else y) for x, y, label in found}


def test_points_stand_at_their_numbers_between_the_ticks() -> None:
    points = (Point(0, 10, label="first"), Point(5, 20), Point(10, 20))
    svg = line_chart([Series("s", points)], Axis("x"), Axis("y"))
    places = circles(svg)
    along, up = ticks(svg, "middle"), ticks(svg, "end")
    assert places[1][0] == pytest.approx((places[0][0] + places[2][0]) / 2, abs=0.11)
    assert places[0][0] == pytest.approx(along["0"], abs=0.11)
    assert places[2][0] == pytest.approx(along["10"], abs=0.11)
    # Labels stand four units below the middle of their text; up is where numbers are larger.
    assert places[0][1] == pytest.approx(up["10"] - 4, abs=0.11)
    assert places[1][1] == places[2][1] == pytest.approx(up["20"] - 4, abs=0.11)
    assert places[1][1] < places[0][1]
    assert all(LEFT < x < WIDTH - RIGHT and TOP < y < HEIGHT - BOTTOM for x, y in places)
    assert "<title>s first</title>" in svg


def test_on_a_logarithm_equal_ratios_are_equal_distances() -> None:
    points = tuple(Point(x, 1 + i) for i, x in enumerate((1e4, 1e5, 1e6)))
    svg = line_chart([Series("s", points)], Axis("bytes", log=True, form=short_size), Axis("y"))
    (a, _), (b, _), (c, _) = circles(svg)
    assert b - a == pytest.approx(c - b, abs=0.11)
    along = ticks(svg, "middle")
    assert {"10 kB", "30 kB", "100 kB", "300 kB", "1 MB"} <= set(along)
    assert along["100 kB"] == pytest.approx(b, abs=0.11)


@pytest.mark.parametrize("values", [(418_200.0, 492_425.0), (5e4, 5e4), (1.0, 9.9)])
def test_every_logarithmic_axis_has_ticks(values: tuple[float, float]) -> None:
    svg = line_chart(
        [Series("s", tuple(Point(v, v) for v in values))], Axis("x", log=True), Axis("y", log=True)
    )
    assert len(ticks(svg, "middle")) >= 3 and len(ticks(svg, "end")) >= 2


@pytest.mark.parametrize("values", [(27.3, 28.9), (0.9, 0.9), (0.0, 0.0), (-3.0, 1e6)])
def test_every_even_axis_has_a_few_round_ticks(values: tuple[float, float]) -> None:
    svg = line_chart([Series("s", tuple(Point(v, v) for v in values))], Axis("x"), Axis("y"))
    found = [float(label) for label in ticks(svg, "end")]
    assert 2 <= len(found) <= 8
    steps = [round(b - a, 9) for a, b in itertools.pairwise(found)]
    assert max(steps) == pytest.approx(min(steps), rel=1e-6)
    assert f"{steps[0]:.6e}"[:8] in ("1.000000", "2.000000", "5.000000")


def test_spreads_are_bars_of_twice_their_length() -> None:
    points = (Point(0, 0), Point(10, 10, x_spread=2, y_spread=1))
    svg = line_chart([Series("s", points)], Axis("x"), Axis("y"))
    (x0, y0), (x1, y1) = circles(svg)
    down, up = map(float, re.findall(rf'd="M{x1:.1f} ([\d.]+)V([\d.]+)"', svg)[-1])
    assert abs(down - up) == pytest.approx(2 * (y0 - y1) / 10, abs=0.3)
    left, right = map(float, re.findall(rf'd="M([\d.]+) {y1:.1f}H([\d.]+)"', svg)[-1])
    assert right - left == pytest.approx(4 * (x1 - x0) / 10, abs=0.3)


def test_what_has_no_place_is_left_out() -> None:
    points = (Point(1, math.inf), Point(0, 1), Point(10, 2))
    svg = line_chart([Series("s", points)], Axis("x", log=True), Axis("y"))
    assert len(circles(svg)) == 1
    assert line_chart([Series("s", points[:1])], Axis("x"), Axis("y")) == ""


def test_names_are_text() -> None:
    series = Series("<b>&", (Point(1, 1),))
    charts = line_chart([series], Axis("<x>"), Axis("y")), shares_chart([("<b>&", [1], "")], ["n"])
    for svg in (*charts, legend([series])):
        assert "<b>" not in svg and "<x>" not in svg and "&lt;b&gt;&amp;" in svg


def test_shares_of_a_bar_are_as_long_as_they_are_large() -> None:
    svg = shares_chart([("a", [30, 0, 10], "40 B"), ("b", [5, 5, 0], "10 B")], ["p", "q", "r"])
    widths = [float(w) for w in re.findall(r'<rect [^>]*width="([\d.]+)"', svg)]
    assert len(widths) == 4
    assert widths[0] == pytest.approx(3 * widths[1], abs=0.1)
    assert widths[2] == widths[3] == pytest.approx((widths[0] + widths[1]) / 2, abs=0.1)
    assert "<title>p: 30, 75.0 %</title>" in svg and ">40 B</text>" in svg
    assert [svg.count(f'fill="{ink}"') for ink in PALETTE[:3]] == [2, 1, 1]
