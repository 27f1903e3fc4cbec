"""Charts as SVG within a page: lines with points and bars of their spread, and stacked bars. Colors follow the page."""

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

# Apart for every kind of color vision (Okabe and Ito); light enough for dark pages, dark enough for light ones.
PALETTE = (
    "#0080c8",
    "#e06a10",
    "#009e73",
    "#cc69a0",
    "#8c7ae6",
    "#b89b00",
    "#4aa8e0",
    "#c94b4b",
    "#7f8c8d",
    "#5d9c3f",
)
MARKERS = ("circle", "square", "triangle", "diamond")
WIDTH, HEIGHT = 480, 320  # units of the drawing
LEFT, RIGHT, TOP, BOTTOM = 72, 14, 12, 46  # margins
TICKS = 6  # about as many on an axis
MARGIN = 0.06  # of an axis' length, beside the outermost points


@dataclass(frozen=True)
class Point:
    x: float
    y: float
    x_spread: float | None = None  # half length of a bar
    y_spread: float | None = None
    label: str = ""  # shown when pointed at


@dataclass(frozen=True)
class Series:
    name: str
    points: tuple[Point, ...]
    style: int = 0  # which color and marker
    marked: bool = True  # a marker at each point


@dataclass(frozen=True)
class Axis:
    label: str
    log: bool = False
    form: Callable[[float], str] = "{:g}".format

    def place(self, value: float) -> float:
        """Along the axis, in any unit."""
        return math.log10(value) if self.log else value


def color(style: int) -> str:
    return PALETTE[style % len(PALETTE)]


def line_chart(series: Sequence[Series], x: Axis, y: Axis) -> str:
    """An `<svg>`; points that are not finite, or that a logarithm has none of, are left out."""
    series = [_drawable(each, x, y) for each in series]
    points = [point for each in series for point in each.points]
    if not points:
        return ""
    across = _Scale.of([p.x for p in points], x, LEFT, WIDTH - RIGHT)
    upward = _Scale.of([p.y for p in points], y, HEIGHT - BOTTOM, TOP)
    parts = [*_x_axis(across), *_y_axis(upward)]
    for each in series:
        parts += _line(each, across, upward)
    return _svg(parts, WIDTH, HEIGHT, f"{y.label} over {x.label}")


def legend(series: Sequence[Series], *, squares: bool = False) -> str:
    """What the colors and markers mean; those of bars are squares."""
    items = []
    for each in series:
        if squares:
            drawn = [f'<rect x="3" y="3" width="11" height="11" fill="{color(each.style)}"/>']
        elif each.marked:
            drawn = _marker(each.style, 8, 8, 5)
        else:
            drawn = [_stroke([(1, 8), (15, 8)], each.style)]
        sign = f'<svg viewBox="0 0 16 16" width="16" height="16" aria-hidden="true">{"".join(drawn)}</svg>'
        items.append(f"<span>{sign} {html.escape(each.name)}</span>")
    return f'<p class="legend">{"".join(items)}</p>\n'


def shares_chart(rows: Sequence[tuple[str, Sequence[float], str]], names: Sequence[str]) -> str:
    """A bar a row: its label, its parts (one for each of `names`) as shares of their sum, and a word on the right."""
    height, gap, label, note = 20, 7, 215, 70
    width = 760
    parts = []
    for i, (title, values, word) in enumerate(rows):
        top = i * (height + gap)
        middle = top + height / 2 + 4
        parts.append(f'<text x="{label - 8}" y="{middle:g}" text-anchor="end">{html.escape(title)}</text>')
        total = max(sum(values), 1e-300)
        left = float(label)
        for style, (name, value) in enumerate(zip(names, values, strict=True)):
            wide = value / total * (width - label - note)
            if wide > 0:
                told = html.escape(f"{name}: {value:,.0f}, {100 * value / total:.1f} %")
                parts.append(
                    f'<rect x="{left:.2f}" y="{top}" width="{wide:.2f}" height="{height}" fill="{color(style)}">'
                    f"<title>{told}</title></rect>"
                )
            left += wide
        parts.append(f'<text x="{left + 8:.2f}" y="{middle:g}">{html.escape(word)}</text>')
    tall = len(rows) * (height + gap)
    return _svg(parts, width, tall, "shares by component", "bars")


@dataclass(frozen=True)
class _Scale:
    """Maps values to units of the drawing."""

    axis: Axis
    low: float  # values, or their logarithms
    high: float
    start: float  # drawing
    end: float

    @staticmethod
    def of(values: Sequence[float], axis: Axis, start: float, end: float) -> "_Scale":
        places = [axis.place(value) for value in values]
        low, high = min(places), max(places)
        # Of a single value, a little to both sides.
        beside = MARGIN * (high - low) or max(abs(high) * 0.01, 0.01)
        return _Scale(axis, low - beside, high + beside, start, end)

    def __call__(self, value: float) -> float:
        return self.of_place(self.axis.place(value))

    def of_place(self, place: float) -> float:
        return self.start + (place - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Values."""
        return _log_ticks(self.low, self.high) if self.axis.log else _even_ticks(self.low, self.high)


def _even_ticks(low: float, high: float) -> list[float]:
    """Place ticks at 1, 2 or 5 times a power of ten."""
    rough = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [round(i * step, 12) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Place ticks at powers of ten, and at 2 and 5 or 3 times those where there is room."""
    factors = (1, 2, 5) if high - low < 1.6 else (1, 3) if high - low < 3 else (1,)
    decades = range(math.floor(low), math.ceil(high) + 1)
    ticks = [factor * 10.0**decade for decade in decades for factor in factors]
    found = [tick for tick in ticks if low <= math.log10(tick) <= high]
    # Within one step of those above: any round values.
    return (
        found if len(found) > 1 else [10.0 ** (low + part * (high - low)) for part in (1 / 6, 1 / 2, 5 / 6)]
    )


def _x_axis(scale: _Scale) -> list[str]:
    bottom = HEIGHT - BOTTOM
    parts = [f'<path class="axis" d="M{LEFT} {bottom}H{WIDTH - RIGHT}"/>']
    for tick in scale.ticks():
        x = scale(tick)
        parts.append(f'<path class="grid" d="M{x:.1f} {TOP}V{bottom}"/>')
        parts.append(
            f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{scale.axis.form(tick)}</text>'
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text x="{middle:g}" y="{HEIGHT - 8}" text-anchor="middle">{html.escape(scale.axis.label)}</text>'
    )
    return parts


def _y_axis(scale: _Scale) -> list[str]:
    parts = [f'<path class="axis" d="M{LEFT} {TOP}V{HEIGHT - BOTTOM}"/>']
    for tick in scale.ticks():
        y = scale(tick)
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{scale.axis.form(tick)}</text>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text x="14" y="{middle:g}" text-anchor="middle" transform="rotate(-90 14 {middle:g})">'
        f"{html.escape(scale.axis.label)}</text>"
    )
    return parts


def _line(series: Series, across: _Scale, upward: _Scale) -> list[str]:
    places = [(across(point.x), upward(point.y)) for point in series.points]
    parts = [_stroke(places, series.style)] if len(places) > 1 else []
    for point, (x, y) in zip(series.points, places, strict=True):
        parts += _bars(point, x, y, across, upward, color(series.style))
        if series.marked:
            told = html.escape(f"{series.name} {point.label}".strip())
            drawn = "".join(_marker(series.style, x, y, 4))
            parts.append(f"<g><title>{told}</title>{drawn}</g>")
    return parts


def _bars(point: Point, x: float, y: float, across: _Scale, upward: _Scale, ink: str) -> list[str]:
    """Draw bars for the spread over seeds."""
    parts = []
    if point.y_spread:
        low, high = (upward(point.y + side * point.y_spread) for side in (-1, 1))
        parts.append(f'<path stroke="{ink}" d="M{x:.1f} {low:.1f}V{high:.1f}"/>')
    if point.x_spread and (not across.axis.log or point.x > point.x_spread):
        left, right = (across(point.x + side * point.x_spread) for side in (-1, 1))
        parts.append(f'<path stroke="{ink}" d="M{left:.1f} {y:.1f}H{right:.1f}"/>')
    return parts


def _stroke(places: Sequence[tuple[float, float]], style: int) -> str:
    way = "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
    return f'<path fill="none" stroke="{color(style)}" stroke-width="2" d="M{way}"/>'


def _marker(style: int, x: float, y: float, r: float) -> list[str]:
    ink = f'fill="{color(style)}"'
    kind = MARKERS[style % len(MARKERS)]
    if kind == "circle":
        return [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:g}" {ink}/>']
    corners = {
        "square": ((-1, -1), (1, -1), (1, 1), (-1, 1)),
        "triangle": ((0, -1.2), (1.15, 0.9), (-1.15, 0.9)),
        "diamond": ((0, -1.35), (1.35, 0), (0, 1.35), (-1.35, 0)),
    }[kind]
    way = "L".join(f"{x + r * dx:.1f} {y + r * dy:.1f}" for dx, dy in corners)
    return [f'<path d="M{way}Z" {ink}/>']


def _drawable(series: Series, x: Axis, y: Axis) -> Series:
    def there(value: float, axis: Axis) -> bool:
        return math.isfinite(value) and (value > 0 or not axis.log)

    points = tuple(point for point in series.points if there(point.x, x) and there(point.y, y))
    return Series(series.name, points, series.style, series.marked)


def _svg(parts: Sequence[str], width: float, height: float, title: str, kind: str = "chart") -> str:
    return (
        f'<svg class="{kind}" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{html.escape(title)}">'
        + "\n".join(parts)
        + "</svg>\n"
    )
