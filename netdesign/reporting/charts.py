"""Small charts as inline SVG: they print, scale and follow the page's colours by their classes."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, log10, sqrt

from markupsafe import Markup, escape

from netdesign.reporting.words import finite


@dataclass(frozen=True, kw_only=True)
class IntervalRow:
    """A statistic, its acceptance interval, and where it is expected."""

    label: str
    note: str
    value: float
    low: float
    high: float
    expected: float = 1.0

    @property
    def inside(self) -> bool:
        """Whether the value lies in its interval."""
        return self.low <= self.value <= self.high


def interval_chart(rows: Sequence[IntervalRow], level: str) -> Markup:
    """Return a row per statistic on one logarithmic axis: the interval as a bar, the value as a dot."""
    finite = [x for row in rows for x in (row.value, row.low, row.high, row.expected) if isfinite(x) and x > 0]
    if not finite:
        return Markup("")
    low, high = min(finite) / 1.08, max(finite) * 1.08
    width, left, right, step, top = 500, 118, 84, 36, 10

    def at(value: float) -> float:
        share = (log10(min(max(value, low), high)) - log10(low)) / (log10(high) - log10(low))
        return left + share * (width - left - right)

    bottom = top + step * len(rows)
    parts = [_tick(tick, at(tick), top, bottom) for tick in _ticks(low, high)]
    for index, row in enumerate(rows):
        y = top + step * (index + 0.5)
        state = "good" if row.inside else "bad"
        parts.append(
            _labels(row, y) + f'<rect class="range" x="{at(row.low):.1f}" y="{y - 6:.1f}" height="12" rx="3" '
            f'width="{max(at(row.high) - at(row.low), 1):.1f}"/>'
            f'<line class="expected" x1="{at(row.expected):.1f}" x2="{at(row.expected):.1f}" y1="{y - 9:.1f}" '
            f'y2="{y + 9:.1f}"/><circle class="{state}" cx="{at(row.value):.1f}" cy="{y:.1f}" r="5"/>'
            + _verdict(row, width - right + 12, y)
        )
    return svg(width, bottom + 20, parts, f"Statistics inside their {level} intervals")


def _tick(value: float, x: float, top: float, bottom: float) -> str:
    """Return an upright line of the axis with its number below."""
    return (
        f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{bottom}"/>'
        f'<text class="tick" x="{x:.1f}" y="{bottom + 14}" text-anchor="middle">{value:g}</text>'
    )


def _labels(row: "IntervalRow | BandRow", y: float) -> str:
    """Return what stands left of a row: its name and, smaller, a note."""
    return (
        f'<text class="label" x="0" y="{y + 1:.1f}">{escape(row.label)}</text>'
        f'<text class="tick" x="0" y="{y + 13:.1f}">{escape(row.note)}</text>'
    )


def _verdict(row: "IntervalRow | BandRow", x: float, y: float) -> str:
    """Return what stands right of a row: its value, and whether it lies where it must."""
    state, sign = ("good", "✓") if row.inside else ("bad", "✗")
    return f'<text class="value {state}" x="{x}" y="{y + 4:.1f}">{row.value:.3f} {sign}</text>'


@dataclass(frozen=True, kw_only=True)
class BandRow:
    """An estimate with its confidence interval, and the margin it must stay in."""

    label: str
    note: str
    value: float
    low: float
    high: float
    margin: tuple[float, float]

    @property
    def inside(self) -> bool:
        """Whether the whole interval lies in the margin."""
        return self.margin[0] <= self.low and self.high <= self.margin[1]


def band_chart(rows: Sequence[BandRow]) -> Markup:
    """Return a row per estimate: the margin as a bar, the confidence interval as a line, the estimate as a dot."""
    if not rows:
        return Markup("")
    low = min(min(row.low, row.margin[0]) for row in rows) - 0.03
    high = max(max(row.high, row.margin[1]) for row in rows) + 0.03
    width, left, right, step, top = 500, 118, 110, 36, 10

    def at(value: float) -> float:
        return left + (value - low) / (high - low) * (width - left - right)

    bottom = top + step * len(rows)
    parts = [_tick(tick, at(tick), top, bottom) for tick in _ticks(max(low, 1e-3), high)]
    for index, row in enumerate(rows):
        y = top + step * (index + 0.5)
        state = "good" if row.inside else "bad"
        parts.append(
            _labels(row, y) + f'<rect class="range" x="{at(row.margin[0]):.1f}" y="{y - 8:.1f}" height="16" rx="3" '
            f'width="{at(row.margin[1]) - at(row.margin[0]):.1f}"/>'
            f'<line class="whisker {state}" x1="{at(row.low):.1f}" x2="{at(row.high):.1f}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<circle class="{state}" cx="{at(row.value):.1f}" cy="{y:.1f}" r="5"/>'
            + _verdict(row, width - right + 12, y)
        )
    return svg(width, bottom + 20, parts, "Estimates with 90 % intervals inside their margins")


def dot_chart(rows: Sequence[tuple[str, str, float, str]], unit: str) -> Markup:
    """Return a bar from zero per (label, note, value, class): a few numbers side by side."""
    values = [value for _, _, value, _ in rows if isfinite(value)]
    if not values:
        return Markup("")
    high = max(values) * 1.02
    width, left, right, step, top = 500, 196, 84, 34, 4
    parts = []
    for index, (label, note, value, kind) in enumerate(rows):
        y = top + step * (index + 0.5)
        length = (width - left - right) * (value / high if isfinite(value) else 0)
        words = f"{finite(value)} {unit}" if isfinite(value) else "undetermined"
        parts.append(
            f'<text class="label" x="0" y="{y:.1f}">{escape(label)}</text>'
            f'<text class="tick" x="0" y="{y + 12:.1f}">{escape(note)}</text>'
            f'<rect class="{kind}" x="{left}" y="{y - 8:.1f}" width="{length:.1f}" height="14" rx="3"/>'
            f'<text class="value" x="{left + length + 8:.1f}" y="{y + 4:.1f}">{words}</text>'
        )
    return svg(width, top + step * len(rows) + 4, parts, "Predicted and achieved")


def line_chart(x: Sequence[float], y: Sequence[float], x_name: str, y_name: str) -> Markup:
    """Return one curve with the names of its axes and the values at its ends."""
    if len(x) < 2:
        return Markup("")
    width, height, left, bottom, top = 420, 150, 44, 30, 10
    x0, x1, y0, y1 = min(x), max(x), min(y), max(y)
    spread_x, spread_y = (x1 - x0) or 1.0, (y1 - y0) or 1.0

    def place(a: float, b: float) -> tuple[float, float]:
        across = left + (a - x0) / spread_x * (width - left - 12)
        return across, height - bottom - (b - y0) / spread_y * (height - bottom - top)

    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in map(place, x, y))
    base = height - bottom
    parts = [
        f'<line class="axis" x1="{left}" x2="{width - 12}" y1="{base}" y2="{base}"/>',
        f'<line class="axis" x1="{left}" x2="{left}" y1="{top}" y2="{base}"/>',
        f'<polyline class="curve" points="{path}"/>',
        f'<text class="tick" x="{left - 6}" y="{base + 3}" text-anchor="end">{y0:.3g}</text>',
        f'<text class="tick" x="{left - 6}" y="{top + 7}" text-anchor="end">{y1:.3g}</text>',
        f'<text class="tick" x="{left}" y="{base + 14}">{x0:,.0f}</text>',
        f'<text class="tick" x="{width - 12}" y="{base + 14}" text-anchor="end">{x1:,.0f}</text>',
        f'<text class="tick" x="{(left + width) // 2}" y="{height - 3}" text-anchor="middle">{escape(x_name)}</text>',
        f'<text class="tick" x="{left + 8}" y="{top + 7}">{escape(y_name)}</text>',
    ]
    return svg(width, height, parts, f"{y_name} against {x_name}")


def histogram_chart(values: Sequence[float], name: str, bins: int) -> Markup:
    """Return the histogram of values that should be uniform on [0, 1], with the 95 % band of a uniform sample."""
    count = len(values)
    if not count:
        return Markup("")
    heights = [0] * bins
    for value in values:
        heights[min(int(value * bins), bins - 1)] += 1
    expected = count / bins
    spread = 1.96 * sqrt(expected * (1 - 1 / bins))
    high = max(*heights, expected + spread) * 1.08
    width, height, left, bottom, top = 200, 132, 8, 22, 20
    step = (width - 2 * left) / bins

    def level(value: float) -> float:
        return height - bottom - max(value, 0) / high * (height - bottom - top)

    band = level(max(expected - spread, 0)) - level(expected + spread)
    parts = [
        f'<rect class="range" x="{left}" width="{width - 2 * left}" y="{level(expected + spread):.1f}" '
        f'height="{band:.1f}"/>',
        *(
            f'<rect class="total" x="{left + index * step + 1:.1f}" width="{step - 2:.1f}" y="{level(value):.1f}" '
            f'height="{height - bottom - level(value):.1f}" rx="1.5"/>'
            for index, value in enumerate(heights)
        ),
        f'<line class="expected" x1="{left}" x2="{width - left}" y1="{level(expected):.1f}" '
        f'y2="{level(expected):.1f}"/>',
        f'<text class="label" x="{left}" y="12">{escape(name)}</text>',
        f'<text class="tick" x="{left}" y="{height - 8}">0</text>',
        f'<text class="tick" x="{width - left}" y="{height - 8}" text-anchor="end">1</text>',
    ]
    return svg(width, height, parts, f"Histogram of the probability integral transform of {name}")


def _ticks(low: float, high: float) -> list[float]:
    """Return round numbers on a logarithmic axis: enough, not many."""
    fine = [0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.6, 2.0]
    coarse = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0, 1e4]
    chosen = fine if high / low < 3.2 else coarse
    return [tick for tick in chosen if low <= tick <= high]


def svg(width: float, height: float, parts: Sequence[str], title: str) -> Markup:
    """Return a picture of the given parts; the title is read aloud."""
    # Every text that comes from outside has been escaped where it was put in.
    body = "".join(parts)
    return Markup(
        f'<svg class="chart" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(title)}">{body}</svg>'
    )
