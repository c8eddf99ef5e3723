"""Covariance of adjusted points when the corners of a tag do not err independently.

The corners of a tag are measured together. The fit knows their joint covariance: a tag's centre is about a fifth
better, its turn in the picture worse than four independent corners would make it. The adjustment weights every
corner by its own 2 x 2 covariance. Its estimates stay unbiased, but with the true covariance C of the whitened image
points they spread by

    Σ = Q (Aᵀ C A) Q,    Q = the inverse of the normal equations AᵀA with inner constraints over the points,

not by Q. In strong networks the difference is some per cent; where one bending of a whole network carries most of the
error it depends on the centres, and Q promises too little.
"""

from collections.abc import Mapping

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from netdesign.adjustment.compare import point_equations
from netdesign.adjustment.statistics import SumsOfSquares
from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Floats
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.observation_equations import whitener


def correlated_errors(
    adjustment: Adjustment, tag_covariance: Mapping[tuple[int, int], Floats]
) -> tuple[Floats, SumsOfSquares]:
    """Return the joint covariance (3m, 3m) m² of the points, inf for unused ones, in the free datum; and T and vᵀPv.

    Args:
        adjustment: free datum; point p is corner p mod 4 of tag p div 4.
        tag_covariance: (8, 8) px² by (image, tag) for every tag that is observed, order x0 y0 x1 y1 …
    """
    linearised, observations = point_equations(adjustment), adjustment.observations
    whiten = whitener(observations.covariance)
    used = np.flatnonzero(adjustment.used)
    place = np.full(len(adjustment.points), -1)
    place[used] = np.arange(len(used))
    width, size = linearised.width, linearised.width + 3 * len(used)
    normal, middle, outer = (np.zeros((size, size)) for _ in range(3))
    trace, trace_of_square = 0.0, 0.0
    tag = observations.point // CORNERS_PER_TAG
    order = np.lexsort((tag, observations.image))
    starts = np.flatnonzero(np.diff(observations.image[order], prepend=-1) | np.diff(tag[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        corner = observations.point[rows] % CORNERS_PER_TAG
        seat = (2 * corner[:, None] + [0, 1]).ravel()
        whole = np.asarray(tag_covariance[int(observations.image[rows[0]]), int(tag[rows[0]])])
        turned = np.zeros((2 * len(rows), 2 * len(rows)))
        for index, row in enumerate(rows):
            turned[2 * index : 2 * index + 2, 2 * index : 2 * index + 2] = whiten[row]
        columns = linearised.columns[rows[0]]
        known = columns >= 0
        own = width + 3 * place[observations.point[rows]][:, None] + np.arange(3)
        unknowns = np.concatenate([columns[known], own.ravel()])
        design = np.zeros((2 * len(rows), len(unknowns)))
        design[:, : known.sum()] = linearised.camera[rows][:, :, known].reshape(2 * len(rows), -1)
        for index, row in enumerate(rows):
            first = int(known.sum()) + 3 * index
            design[2 * index : 2 * index + 2, first : first + 3] = linearised.point_part[row]
        whitened = turned @ whole[np.ix_(seat, seat)] @ turned.T
        normal[np.ix_(unknowns, unknowns)] += design.T @ design
        middle[np.ix_(unknowns, unknowns)] += design.T @ whitened @ design
        outer[np.ix_(unknowns, unknowns)] += design.T @ whitened @ whitened @ design
        trace += float(np.trace(whitened))
        trace_of_square += float((whitened**2).sum())
    covariance, through, outside = _between(normal, middle, outer, adjustment.points[used], width)
    sums = _sums_of_squares(normal, middle, outer, through, outside, width, (trace, trace_of_square))
    joint = np.zeros((3 * len(adjustment.points),) * 2)
    all_rows = np.repeat(adjustment.used, 3)
    joint[np.ix_(all_rows, all_rows)] = covariance
    unused = np.flatnonzero(~all_rows)
    joint[unused, unused] = np.inf
    return joint, sums


def _between(normal: Floats, middle: Floats, outer: Floats, points: Floats, width: int) -> tuple[Floats, Floats, float]:
    """Return the points' part of Q M Q, Q M and tr(Q O), Q the inverse with inner constraints over points (u, 3)."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    constraints = np.zeros((len(normal), 7))
    constraints[width:] = inner_basis(points)
    held = np.linalg.qr(scale[:, None] * constraints)[0]
    # The normals times the motions vanish, so that constraints may be added as observations without changing Q M Q,
    # nor the trace of Q times anything that vanishes with the motions.
    factor = cho_factor(scale[:, None] * normal * scale + held @ held.T, lower=True)
    once = cho_solve(factor, scale[:, None] * middle * scale)
    twice = scale[:, None] * cho_solve(factor, once.T) * scale
    outside = float(np.trace(cho_solve(factor, scale[:, None] * outer * scale)))
    return np.asarray(twice[width:, width:]), scale[:, None] * once / scale, outside


def _sums_of_squares(
    normal: Floats, middle: Floats, outer: Floats, through: Floats, outside: float, width: int,
    of_covariance: tuple[float, float],
) -> SumsOfSquares:  # fmt: skip
    """Return mean, variance and covariance of T and V for errors ε of covariance C: quadratic forms of projections.

    V = εᵀ(I - H)ε and T = εᵀ(H - K)ε, H the projection on all unknowns, K on the stations alone. The mean of εᵀPε is
    tr(PC), the covariance of two of them 2 tr(PCRC); every trace is one of products with Q or with the inverse of the
    stations' normals.

    Args:
        middle: AᵀCA.  outer: AᵀC²A.  through: Q AᵀCA.  outside: tr(Q AᵀC²A).  of_covariance: tr(C), tr(C²).
    """
    cameras = cho_factor(normal[:width, :width], lower=True)
    station = cho_solve(cameras, middle[:width])
    h, k = float(np.trace(through)), float(np.trace(station[:, :width]))
    h_square, k_square = outside, float(np.trace(cho_solve(cameras, outer[:width, :width])))
    hh = float((through * through.T).sum())
    hk = float((through[:, :width] * station.T).sum())
    kk = float((station[:, :width] * station[:, :width].T).sum())
    return SumsOfSquares(
        t_mean=h - k,
        t_variance=2.0 * (hh - 2.0 * hk + kk),
        v_mean=of_covariance[0] - h,
        v_variance=2.0 * (of_covariance[1] - 2.0 * h_square + hh),
        common=2.0 * ((h_square - k_square) - (hh - hk)),
    )
