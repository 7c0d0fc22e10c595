# SPDX-License-Identifier: GPL-3.0-or-later
"""Small plots as inline SVG: no library, no script, readable in print. Colours come from the page's style classes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH = 760
ROW = 30
LABEL = 190  # pixels for the names left of a plot
SERIES_CLASSES = ("series-a", "series-b", "series-c", "series-d", "series-e")


@dataclass(frozen=True)
class Interval:
    """A measured value with its 95 % interval, on one row."""

    label: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Curve:
    """Points (x, y) of one line; y must be positive, as the axis is logarithmic."""

    label: str
    points: Sequence[tuple[float, float]]


def _svg(height: float, parts: Sequence[str], title: str) -> str:
    return (f'<svg viewBox="0 0 {WIDTH} {height:.0f}" role="img" aria-label="{escape(title)}">'
            f"<title>{escape(title)}</title>{''.join(parts)}</svg>")


def _text(x: float, y: float, text: str, style: str = "", anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{style}" text-anchor="{anchor}">{escape(text)}</text>'


def bars(rows: Sequence[tuple[str, float, str]], title: str) -> str:
    """Horizontal bars of (label, value >= 0, what to write behind it)."""
    largest = max((value for _, value, _ in rows), default=0.0)
    room = WIDTH - LABEL - 210
    parts = []
    for index, (label, value, note) in enumerate(rows):
        top = index * ROW
        length = max(1.5, room * value / largest) if largest > 0.0 else 1.5
        parts.append(_text(LABEL - 10, top + 20, label, anchor="end"))
        parts.append(f'<rect x="{LABEL}" y="{top + 6}" width="{length:.1f}" height="{ROW - 11}" rx="3" class="bar"/>')
        parts.append(_text(LABEL + length + 8, top + 20, note, "quiet"))
    return _svg(max(1, len(rows)) * ROW + 4, parts, title)


class _LogAxis:
    """Positions of positive values between two powers of ten, or, within two decades, two of 1, 2, 5, 10, 20, ..."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        last += first == last
        self.ticks = [10.0 ** power for power in range(first, last + 1, max(1, round((last - first) / 8)))]
        if last - first <= 2:
            steps = sorted(self.ticks + [digit * power for power in self.ticks[:-1] for digit in (2.0, 5.0)])
            below, above = sum(step <= low for step in steps) - 1, sum(step < high for step in steps)
            self.ticks = steps[max(below, 0):above + 1]
            first, last = math.log10(self.ticks[0]), math.log10(self.ticks[-1])
        self.first, self.last = first, last
        self.start, self.end = start, end

    def position(self, value: float) -> float:
        share = (math.log10(max(value, 10.0 ** self.first)) - self.first) / (self.last - self.first)
        return self.start + min(share, 1.0) * (self.end - self.start)


@dataclass(frozen=True)
class _LinearAxis:
    """Positions of values from 0 to the largest."""

    largest: float
    start: float
    end: float

    def position(self, value: float) -> float:
        return self.start + (self.end - self.start) * value / self.largest

    @property
    def ticks(self) -> list[float]:
        return [0.0, 0.5 * self.largest, self.largest]


def _x_axis(values: Sequence[float], logarithmic: bool, start: float, end: float) -> _LogAxis | _LinearAxis:
    if logarithmic:
        return _LogAxis(min(values), max(values), start, end)
    return _LinearAxis(max(values) or 1.0, start, end)


def _short(value: float) -> str:
    """A number on an axis: 2500000 -> "2.5 M"."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def percent(value: float) -> str:
    """A share as a short percentage: 0.0123 -> "1.2 %"."""
    scaled = float(f"{100.0 * value:.2g}") if value < 1.0 else 100.0 * value
    digits = 0 if scaled == 0.0 else max(0, min(6, 1 - math.floor(math.log10(abs(scaled)))))
    return f"{scaled:.{digits}f} %"


def intervals(rows: Sequence[Interval], zones: Sequence[tuple[float, str]], title: str) -> str:
    """One dot and whisker per row on a logarithmic axis of shares from 0.01 % to 100 %.

    zones: (upper end, name) of the bands behind, in rising order; the last one ends at 100 %.
    """
    axis = _LogAxis(1e-4, 1.0, LABEL, WIDTH - 110)
    bottom = len(rows) * ROW + 22
    parts, left = [], axis.start
    for index, (upper, name) in enumerate(zones):
        right = axis.position(upper)
        parts.append(f'<rect x="{left:.1f}" y="18" width="{right - left:.1f}" height="{bottom - 18}" '
                     f'class="zone zone-{index}"/>')
        parts.append(_text((left + right) / 2, 12, name, "quiet small", "middle"))
        left = right
    for tick in axis.ticks:
        x = axis.position(tick)
        parts.append(f'<line x1="{x:.1f}" y1="18" x2="{x:.1f}" y2="{bottom}" class="grid"/>')
        parts.append(_text(x, bottom + 15, percent(tick), "quiet small", "middle"))
    for index, row in enumerate(rows):
        y = 18 + ROW * (index + 0.5) + 2
        parts.append(_text(LABEL - 10, y + 5, row.label, anchor="end"))
        parts.append(f'<line x1="{axis.position(row.low):.1f}" y1="{y:.1f}" x2="{axis.position(row.high):.1f}" '
                     f'y2="{y:.1f}" class="whisker"/>')
        parts.append(f'<circle cx="{axis.position(row.value):.1f}" cy="{y:.1f}" r="5.5" class="dot"/>')
        parts.append(_text(WIDTH - 98, y + 5, percent(row.value)))
    return _svg(bottom + 22, parts, title)


def curves(series: Sequence[Curve], x_name: str, y_name: str, title: str, as_percent: bool = True,
           log_x: bool = False) -> str:
    """Lines over a linear x axis from 0, or a logarithmic one, and a logarithmic y axis. Empty text where there is
    nothing to draw."""
    drawn = [Curve(c.label, [(x, y) for x, y in c.points if y > 0.0 and (x > 0.0 or not log_x)]) for c in series]
    drawn = [c for c in drawn if len(c.points) > 1]
    if not drawn:
        return ""
    height, bottom, left, right = 250, 210, 74, WIDTH - 190
    values = [y for c in drawn for _, y in c.points]
    axis = _LogAxis(min(values), max(values), bottom, 26)
    across = _x_axis([x for c in drawn for x, _ in c.points], log_x, left, right)
    parts = [_text(left, 14, y_name, "quiet small")]
    for tick in axis.ticks:
        y = axis.position(tick)
        parts.append(f'<line x1="{left}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}" class="grid"/>')
        parts.append(_text(left - 8, y + 4, percent(tick) if as_percent else _short(tick), "quiet small", "end"))
    for tick in across.ticks:
        parts.append(_text(across.position(tick), bottom + 18, _short(tick), "quiet small", "middle"))
    parts.append(_text((left + right) / 2, bottom + 36, x_name, "quiet small", "middle"))
    for index, curve in enumerate(drawn):
        style = SERIES_CLASSES[index % len(SERIES_CLASSES)]
        places = [(across.position(x), axis.position(y)) for x, y in curve.points]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{line}" class="curve {style}"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" class="mark {style}"/>' for x, y in places]
        parts.append(f'<rect x="{right + 18}" y="{30 + 22 * index}" width="12" height="12" rx="3" '
                     f'class="mark {style}"/>')
        parts.append(_text(right + 36, 41 + 22 * index, curve.label))
    return _svg(height, parts, title)
