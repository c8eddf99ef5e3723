import pytest

from netdesign.model.figures import significant


@pytest.mark.parametrize(
    ("value", "text"),
    [(12861.7, "12862"), (10283.86, "10284"), (9999.96, "10000"), (1234.5678, "1235"), (0.60710302, "0.6071"),
     (-20345.6, "-20346"), (0.0, "0"), (2.0, "2"), (3.2e-7, "3.2e-07"), (4.2e12, "4.2e+12"), (float("inf"), "inf")],
)  # fmt: skip
def test_lengths_are_written_in_full(value, text):
    assert significant(value) == text


def test_the_digits_can_be_chosen():
    assert [significant(value, 3) for value in (0.60710302, 123.456, 12345.6)] == ["0.607", "123", "12346"]
