"""The plot that an acceptance protocol shows: length measurement errors over the length, in what was predicted."""

from math import ceil, floor, log10
from typing import Any

from markupsafe import Markup

from netdesign.reporting.charts import svg

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 500, 236, 46, 12, 12, 38


def length_chart(lengths: list[dict[str, Any]]) -> Markup:
    """Return a dot per test length at its error, over a bar of ± its predicted U95.

    Args:
        lengths: entries of ``length_test`` in validation.json: length_mm, error_um, u95_um.
    """
    rows = [row for row in lengths if None not in (row["length_mm"], row["error_um"], row["u95_um"])]
    if not rows:
        return Markup("")
    longest = 1.04 * max(float(row["length_mm"]) for row in rows)
    highest = 1.08 * max(max(abs(float(row["error_um"])), float(row["u95_um"])) for row in rows)

    def across(length: float) -> float:
        return LEFT + length / longest * (WIDTH - LEFT - RIGHT)

    def up(error: float) -> float:
        return TOP + (1.0 - error / highest) / 2.0 * (HEIGHT - TOP - BOTTOM)

    base = HEIGHT - BOTTOM
    parts = []
    for tick in _ticks(-highest, highest):
        parts.append(
            f'<line class="axis" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{up(tick):.1f}" y2="{up(tick):.1f}"/>'
            f'<text class="tick" x="{LEFT - 6}" y="{up(tick) + 3.5:.1f}" text-anchor="end">{tick:g}</text>'
        )
    for tick in _ticks(0.0, longest):
        parts.append(
            f'<line class="axis" x1="{across(tick):.1f}" x2="{across(tick):.1f}" y1="{base}" y2="{base + 4}"/>'
            f'<text class="tick" x="{across(tick):.1f}" y="{base + 15}" text-anchor="middle">{tick:g}</text>'
        )
    for row in rows:
        x, upper, lower = across(row["length_mm"]) - 4, up(row["u95_um"]), up(-row["u95_um"])
        parts.append(f'<rect class="range" x="{x:.1f}" width="8" y="{upper:.1f}" height="{lower - upper:.1f}" rx="2"/>')
    parts.append(f'<line class="expected" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{up(0):.1f}" y2="{up(0):.1f}"/>')
    for row in rows:
        state = "good" if abs(row["error_um"]) <= row["u95_um"] else "bad"
        parts.append(
            f'<circle class="{state}" cx="{across(row["length_mm"]):.1f}" cy="{up(row["error_um"]):.1f}" r="3.4"/>'
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text class="tick" x="{middle:.1f}" y="{HEIGHT - 4}" text-anchor="middle">test length, mm</text>'
        f'<text class="tick" x="{LEFT + 6}" y="{TOP + 3}">length measurement error, µm</text>'
    )
    return svg(WIDTH, HEIGHT, parts, "Length measurement errors over the length, with the predicted U95")


def _ticks(low: float, high: float) -> list[float]:
    """Return round numbers from low to high, about six."""
    raw = (high - low) / 6.0
    decade = 10.0 ** floor(log10(raw))
    step = next(decade * factor for factor in (1.0, 2.0, 5.0, 10.0) if decade * factor >= raw)
    return [step * k for k in range(ceil(low / step), floor(high / step) + 1)]
