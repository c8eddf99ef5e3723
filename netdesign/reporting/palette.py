"""Colours of the report: Okabe and Ito's, safe for colour-blind readers, and one ordered scale."""

from collections.abc import Iterable

import matplotlib
import numpy as np
from matplotlib.colors import to_hex

from netdesign.model.arrays import Floats

PREDICTED_LIMITED = "#56b4e9"
PREDICTED_TOTAL = "#0072b2"
ACHIEVED = "#d55e00"
GOOD = "#00795a"
BAD = "#c0392b"
BOUND = "#777777"
TOUR = "#cc6677"


def ordered(values: Iterable[float]) -> list[str]:
    """Return a colour for each value on viridis, its ends left out; equal values, equal colours."""
    array = np.array(list(values), dtype=np.float64)
    low, high = (array.min(), array.max()) if len(array) else (0.0, 1.0)
    share = (array - low) / (high - low) if high > low else np.full(len(array), 0.4)
    return [to_hex(color) for color in matplotlib.colormaps["viridis"](0.10 + 0.80 * share)]


def heat(values: Floats, low: float, high: float) -> Floats:
    """Return (…, 4) colours of a sigma between ``low`` and ``high`` on cividis."""
    share = np.clip((values - low) / (high - low if high > low else 1.0), 0, 1)
    return np.asarray(matplotlib.colormaps["cividis"](share))
