"""Length measurement error in the manner of VDI/VDE 2634 part 1: test lengths along seven lines through the volume.

The lines: four space diagonals of the box that holds the object points and three through its centre parallel to its
edges. On each, at least five lengths between object points, the longest as near to the whole line as the points allow.
A real acceptance test lays bars along the lines; here pairs of object points do, chosen by position alone, never by
their errors.

    length error  dL = L_estimated - L_true,   var L = [-e; e]ᵀ Σ_ab [-e; e],  e the unit vector from a to b
    U95 = 2 sqrt(var L)   from the full covariance, point-to-point correlations included

The estimate is carried to the scale of the truth when the datum is free (its scale is nobody's); with scale bars or
control it is compared as it is.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, chi2

from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.frames import similarity

LINES = 7
LENGTHS_PER_LINE = 5
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True, kw_only=True)
class LengthTest:
    """Test lengths with what was predicted and what was achieved.

    Attributes:
        line: (q,) 0 to 6.  a, b: (q,) point indices.
        length: (q,) true length, m.  error: (q,) m, estimated - true.
        u95: (q,) predicted expanded uncertainty (k = 2), m.
        inside: share of lengths with |error| <= u95; expected 0.9545, 99 % acceptance interval from ``low`` to 1 if the
            lengths were independent.
        longest_share: longest length over the diagonal of the points' box; the guideline asks for 2/3.
        scale_free: the estimate was scaled to the truth first.
    """

    line: Ints
    a: Ints
    b: Ints
    length: Floats
    error: Floats
    u95: Floats
    inside: float
    low: float
    longest_share: float
    scale_free: bool

    @property
    def rms_ratio(self) -> float:
        """Root mean square of error / predicted sigma: about 1 if the prediction is right."""
        return float(np.sqrt(((self.error / (self.u95 / COVERAGE_FACTOR)) ** 2).mean()))


def length_uncertainty(points: Floats, joint: Floats, a: Ints, b: Ints) -> Floats:
    """Return the standard uncertainty (q,) m of the distances between points a and b (q,).

    Args:
        points: (m, 3) m.  joint: (3m, 3m) m², covariance of all points.
    """
    direction = points[b] - points[a]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    rows = np.concatenate([3 * a[:, None] + np.arange(3), 3 * b[:, None] + np.arange(3)], axis=1)
    weights = np.concatenate([-direction, direction], axis=1)
    block = joint[rows[:, :, None], rows[:, None, :]]
    return np.asarray(np.sqrt(np.maximum(np.einsum("qi,qij,qj->q", weights, block, weights), 0.0)))


def chosen_lengths(points: Floats, usable: Bools) -> tuple[Ints, Ints, Ints]:
    """Return line, a, b (q,) of the test lengths, chosen by position.

    Per line: the points are ordered along it, those far from it count less; the two ends that lie best, and four more
    lengths from the first end to points spread along the line.

    Raises:
        InfeasibleError: fewer than six usable points.
    """
    index = np.flatnonzero(usable)
    if len(index) < LENGTHS_PER_LINE + 1:
        raise InfeasibleError(f"length test: expected at least 6 points with an estimate, found {len(index)}")
    low, high = points[index].min(axis=0), points[index].max(axis=0)
    centre, extent = 0.5 * (low + high), high - low
    signs = np.array(
        [[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64
    )
    lines: list[int] = []
    ends: list[tuple[int, int]] = []
    for number, sign in enumerate(signs):
        reach = float(np.linalg.norm(sign * extent))
        if reach <= 1e-9 * float(np.linalg.norm(extent)):
            continue  # a flat object has no lines across its plane
        axis = sign * extent / reach
        offset = points[index] - centre
        along = offset @ axis
        away = np.linalg.norm(offset - along[:, None] * axis, axis=1)
        first = index[int(np.argmin(along + 0.5 * away))]
        chosen: set[int] = {int(first)}
        for step in range(LENGTHS_PER_LINE, 0, -1):
            goal = -0.5 * reach + reach * step / LENGTHS_PER_LINE
            order = np.argsort(np.abs(along - goal) + 0.5 * away, kind="stable")
            other = next(int(index[j]) for j in order if int(index[j]) not in chosen)
            chosen.add(other)
            lines.append(number)
            ends.append((int(first), other))
    both = np.array(ends, dtype=np.int64)
    return np.array(lines, dtype=np.int64), both[:, 0], both[:, 1]


def length_test(truth: Floats, adjustment: Adjustment) -> LengthTest:
    """Return predicted and achieved length measurement errors.

    Args:
        truth: (m, 3) m.  adjustment: with its joint covariance.

    Raises:
        InfeasibleError: too few points.
    """
    if adjustment.joint_covariance is None:
        raise ValueError("adjustment: expected one with its joint covariance")
    used = adjustment.used
    line, a, b = chosen_lengths(truth, used)
    points = adjustment.points
    scale_free = adjustment.n_datum == 7
    if scale_free:
        scale, _, _ = similarity(points[used], truth[used])
        points = points * scale
    length = np.linalg.norm(truth[a] - truth[b], axis=1)
    error = np.linalg.norm(points[a] - points[b], axis=1) - length
    u95 = COVERAGE_FACTOR * length_uncertainty(points, adjustment.joint_covariance, a, b)
    inside = float((np.abs(error) <= u95).mean())
    expected = float(chi2.cdf(COVERAGE_FACTOR**2, 1))
    box = float(np.linalg.norm(np.ptp(truth[used], axis=0)))
    return LengthTest(
        line=line,
        a=a,
        b=b,
        length=length,
        error=error,
        u95=u95,
        inside=inside,
        low=float(binom.ppf(0.01, len(line), expected) / len(line)),
        longest_share=float(length.max() / box),
        scale_free=scale_free,
    )
