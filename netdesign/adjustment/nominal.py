"""Adjusted points against the nominal coordinates of their tags: tags that are not where they should be."""

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import similarity
from netdesign.model.scene import CORNERS_PER_TAG

STEPS = 20
SPREADS = 10  # times the others' median deviation
LEAST_TAGS = 4


def misplaced_tags(points: Floats, nominal: Floats, used: Bools) -> tuple[Floats, Bools]:
    """Compare tags with their nominal places after a similarity transformation that the better half of them decides.

    A tag is misplaced when a corner deviates by more than half the tag's edge, and by more than 10 times the median:
    less may be the care with which tags were put on, an id in the wrong place is more.

    Args:
        points, nominal: (4 g, 3) m, tag by tag.
        used: (4 g,) points that have an estimate.

    Returns:
        (g,) largest deviation of a corner, m, NaN without estimate; (g,) misplaced.
    """
    corners, expected = (values.reshape(-1, CORNERS_PER_TAG, 3) for values in (points, nominal))
    whole = np.flatnonzero(used.reshape(-1, CORNERS_PER_TAG).all(axis=1))
    deviation = np.full(len(corners), np.nan)
    if len(whole) < LEAST_TAGS:
        return deviation, np.zeros(len(corners), bool)
    held = whole
    for _ in range(STEPS):
        scale, rotation, shift = similarity(corners[held].reshape(-1, 3), expected[held].reshape(-1, 3))
        moved = scale * corners[whole] @ rotation.T + shift
        deviation[whole] = np.linalg.norm(moved - expected[whole], axis=2).max(axis=1)
        # Least trimmed squares by concentration: P. J. Rousseeuw, K. van Driessen, Data Mining 12, 2006.
        better = np.sort(whole[np.argsort(deviation[whole], kind="stable")[: len(whole) // 2 + 1]])
        if np.array_equal(better, held):
            break
        held = better
    edge = float(np.linalg.norm(expected[0, 1] - expected[0, 0]))
    limit = max(edge / 2, SPREADS * float(np.median(deviation[whole])))
    return deviation, np.nan_to_num(deviation) > limit
