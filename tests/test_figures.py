import pytest

from netdesign.model.figures import significant
from netdesign.reporting.words import finite
from netdesign.validate import _line


@pytest.mark.parametrize(
    ("value", "text"),
    [(12861.7, "12862"), (10283.86, "10284"), (9999.96, "10000"), (1234.5678, "1235"), (0.60710302, "0.6071"),
     (-20345.6, "-20346"), (0.0, "0"), (2.0, "2"), (3.2e-7, "3.2e-07"), (4.2e12, "4.2e+12"), (float("inf"), "inf")],
)  # fmt: skip
def test_lengths_are_written_in_full(value, text):
    assert significant(value) == text


def test_the_digits_can_be_chosen():
    assert [significant(value, 3) for value in (0.60710302, 123.456, 12345.6)] == ["0.607", "123", "12346"]


def test_the_outcome_of_a_tiny_part_keeps_its_digits():
    record = {
        "network": 2, "repeat": 0, "verdict": "pass", "achieved_rms_um": 0.01234, "reasons": [],
        "predicted_rms_um": {"limited": 0.0101, "total": 0.01357, "used": 1234.5},
        "statistics": {"rho": {"value": 1.0, "low": 0.5, "high": 2.0}},
    }  # fmt: skip
    text = _line(record)
    assert "rms 0.0123 um achieved, 0.0101 limited and 0.0136 total at design, 1234 from" in text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0.0388, 2, "0.039"), (0.0388, 1, "0.039"), (0.5, 2, "0.50"), (12.345, 2, "12.35"), (47.34, 1, "47.3"),
     (0.0, 1, "0.0"), (0.98, 3, "0.980"), (float("inf"), 2, "–")],
)  # fmt: skip
def test_tables_keep_two_digits_of_what_is_small(value, digits, text):
    assert finite(value, digits) == text
