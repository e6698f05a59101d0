"""Charts as inline SVG: lines and dots that take their colours from the page, light or dark."""

import math
from dataclasses import dataclass

from markupsafe import Markup, escape

WIDTH, LEFT, RIGHT, BOTTOM = 760, 66, 14, 44
"""Of every chart, in SVG units: room for the labels of its axes."""


@dataclass(frozen=True)
class Series:
    """What a row shows in a chart.

    Args:
        label: of the row.
        colour: number of the row's colour on the page, 0 to 7.
        hollow: dashed or hollow, for rows without normals.
        values: (x, y) of a line, or (x, name) of dots.
    """

    label: str
    colour: int
    hollow: bool
    values: list[tuple[float, float | str]]


@dataclass(frozen=True)
class _Axis:
    """Maps values to positions; logarithmic or linear."""

    low: float
    high: float
    start: float
    end: float
    log: bool

    def at(self, value: float) -> float:
        scale = math.log10 if self.log else float
        share = (scale(value) - scale(self.low)) / (scale(self.high) - scale(self.low))
        return round(self.start + share * (self.end - self.start), 1)

    def ticks(self) -> list[float]:
        if not self.log:
            step = 10 ** math.floor(math.log10(self.high - self.low))
            step = next(step * f for f in (0.1, 0.2, 0.5, 1, 2) if (self.high - self.low) / (step * f) <= 7)
            first = math.ceil(self.low / step)
            return [step * k for k in range(first, math.floor(self.high / step) + 1)]
        low, high = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        factors = (1, 2, 5) if high - low <= 3 else (1,)
        found = [f * 10.0**k for k in range(low, high + 1) for f in factors]
        found = [value for value in found if self.low <= value <= self.high]
        return found if len(found) > 1 else [float(f"{value:.2g}") for value in self._spread(4)]

    def _spread(self, count: int) -> list[float]:
        """Values at even distances, where an axis is too short for round ones."""
        ratio = self.high / self.low
        return [self.low * ratio ** ((k + 0.5) / count) for k in range(count)]


def line_chart(series: list[Series], x_label: str, y_label: str, height: int = 320) -> Markup:
    """Curves over a linear x axis and a logarithmic y axis; values at or below 0 are left out."""
    lines = [[(x, y) for x, y in one.values if y > 0 and math.isfinite(y)] for one in series]
    drawn = [point for line in lines for point in line]
    if not drawn:
        return Markup("")
    xs, ys = [x for x, _ in drawn], [y for _, y in drawn]
    across = _Axis(min(xs), max(max(xs), min(xs) + 1), LEFT, WIDTH - RIGHT, log=False)
    up = _Axis(*_widened(min(ys), max(ys)), height - BOTTOM, 12, log=True)
    parts = _frame(across, up, height, x_label, y_label)
    for one, line in zip(series, lines, strict=True):
        points = " ".join(f"{across.at(x)},{up.at(y)}" for x, y in line)
        style = f"line c{one.colour}{' hollow' if one.hollow else ''}"
        parts.append(
            f'<polyline class="{style}" points="{points}"><title>{escape(one.label)}</title></polyline>'
        )
    return _svg(parts, height, y_label)


def strip_chart(series: list[Series], x_label: str, marks: list[tuple[float, str]]) -> Markup:
    """A line of dots per row over a logarithmic axis, a bar at its median, and marked values behind all.

    Args:
        series: rows; the second part of each value names its dot.
        x_label: of the axis; values at or below 0 are left out.
        marks: values with a name, such as a noise floor.
    """
    rows = [[(x, name) for x, name in one.values if x > 0 and math.isfinite(x)] for one in series]
    xs = [x for row in rows for x, _ in row] + [x for x, _ in marks if x > 0]
    if not xs:
        return Markup("")
    height, left = 26 * len(series) + BOTTOM + 20, 190
    across = _Axis(*_widened(min(xs), max(xs)), left, WIDTH - RIGHT, log=True)
    parts = _ticks_below(across, height, x_label)
    for x, name in [mark for mark in marks if mark[0] > 0]:
        place = across.at(x)
        parts.append(f'<line class="mark" x1="{place}" x2="{place}" y1="14" y2="{height - BOTTOM}"/>')
        parts.append(f'<text class="tick" x="{place}" y="10" text-anchor="middle">{escape(name)}</text>')
    for k, (one, row) in enumerate(zip(series, rows, strict=True)):
        middle = 30 + 26 * k
        place = f'x="{left - 12}" y="{middle + 4}" text-anchor="end"'
        parts.append(f'<text class="name" {place}>{escape(one.label)}</text>')
        parts += _dots(one, row, across, middle)
    return _svg(parts, height, x_label)


def _dots(one: Series, row: list[tuple[float, str]], across: _Axis, middle: float) -> list[str]:
    style = f"dot c{one.colour}{' hollow' if one.hollow else ''}"
    parts = []
    for k, (x, name) in enumerate(row):
        offset = ((k * 5) % 9 - 4) * 1.3  # spread, the same at every drawing
        told = f"<title>{escape(name)}: {x:.4g}</title>"
        parts.append(
            f'<circle class="{style}" cx="{across.at(x)}" cy="{middle + offset:.1f}" r="3">{told}</circle>'
        )
    if row:
        values = sorted(x for x, _ in row)
        half = len(values) // 2
        median = values[half] if len(values) % 2 else (values[half - 1] + values[half]) / 2
        place = across.at(median)
        told = f"<title>median {median:.4g}</title>"
        ends = f'x1="{place}" x2="{place}" y1="{middle - 10}" y2="{middle + 10}"'
        parts.append(f'<line class="median c{one.colour}" {ends}>{told}</line>')
    return parts


def _widened(low: float, high: float) -> tuple[float, float]:
    return low / 1.15, high * 1.15


def _frame(across: _Axis, up: _Axis, height: int, x_label: str, y_label: str) -> list[str]:
    parts = _ticks_below(across, height, x_label)
    for value in up.ticks():
        y = up.at(value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{value:g}</text>')
    turn = f'transform="translate(14 {(height - BOTTOM) / 2 + 6}) rotate(-90)"'
    return [*parts, f'<text class="label" {turn} text-anchor="middle">{escape(y_label)}</text>']


def _ticks_below(across: _Axis, height: int, label: str) -> list[str]:
    base = height - BOTTOM
    parts = [f'<line class="axis" x1="{across.start}" x2="{across.end}" y1="{base}" y2="{base}"/>']
    for value in across.ticks():
        x = across.at(value)
        parts.append(f'<line class="grid" x1="{x}" x2="{x}" y1="14" y2="{base}"/>')
        parts.append(f'<text class="tick" x="{x}" y="{base + 16}" text-anchor="middle">{value:g}</text>')
    middle = (across.start + across.end) / 2
    return [
        *parts,
        f'<text class="label" x="{middle}" y="{height - 6}" text-anchor="middle">{escape(label)}</text>',
    ]


def _svg(parts: list[str], height: float, label: str) -> Markup:
    head = f'<svg class="chart" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(label)}">'
    return Markup(head + "".join(parts) + "</svg>")
