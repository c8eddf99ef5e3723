"""The plot of an acceptance protocol: every length is there, at its error, coloured by its U95."""

import re

import pytest

from netdesign.reporting.length_chart import length_chart


def _rows(*rows):
    return [{"length_mm": length, "error_um": error, "u95_um": u95} for length, error, u95 in rows]


def test_every_length_is_a_dot_at_its_error():
    chart = length_chart(_rows((50, 2.0, 4.0), (100, -5.0, 4.0), (300, 0.0, 8.0)))
    dots = re.findall(r'<circle class="(\w+)" cx="([\d.]+)" cy="([\d.]+)"', chart)
    assert [kind for kind, _, _ in dots] == ["good", "bad", "good"]
    x, y = ([float(dot[k]) for dot in dots] for k in (1, 2))
    assert (x[1] - x[0]) * 4 == pytest.approx(x[2] - x[1], abs=1)
    bars = re.findall(r'<rect class="range" [^>]*y="([\d.]+)" height="([\d.]+)"', chart)
    top, height = (float(value) for value in bars[2])
    assert top + height / 2 == pytest.approx(y[2], abs=0.1)  # the bar of a length is centred on no error
    assert (y[1] - y[2]) / (height / 2) == pytest.approx(5 / 8, abs=0.02)  # down is negative, in the bars' scale


def test_nothing_to_show_is_nothing():
    assert length_chart([]) == ""
    assert length_chart(_rows((50, 2.0, None))) == ""
