"""Numbers as people read them."""

import math


def significant(value: float, digits: int = 4) -> str:
    """Return a number with ``digits`` significant digits, whole ones in full: 12860, where ``.4g`` says 1.286e+04.

    Exponents stay for what is smaller than 1e-4 or has more than 9 digits before the point.
    """
    if math.isfinite(value) and 10.0 ** (digits - 1) <= abs(value) < 1e9:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"
