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
from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Floats
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.observation_equations import whitener


def correlated_covariance(adjustment: Adjustment, tag_covariance: Mapping[tuple[int, int], Floats]) -> Floats:
    """Return the joint covariance (3m, 3m) m² of the points, inf for unused ones, in the free datum.

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
    normal, middle = np.zeros((size, size)), np.zeros((size, size))
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
    covariance = _between(normal, middle, adjustment.points[used], width)
    joint = np.zeros((3 * len(adjustment.points),) * 2)
    all_rows = np.repeat(adjustment.used, 3)
    joint[np.ix_(all_rows, all_rows)] = covariance
    unused = np.flatnonzero(~all_rows)
    joint[unused, unused] = np.inf
    return joint


def _between(normal: Floats, middle: Floats, points: Floats, width: int) -> Floats:
    """Return the points' part of Q M Q, Q the inverse of the normals with inner constraints over the points (u, 3)."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    constraints = np.zeros((len(normal), 7))
    constraints[width:] = inner_basis(points)
    held = np.linalg.qr(scale[:, None] * constraints)[0]
    # The normals times the motions vanish, so that constraints may be added as observations without changing Q M Q.
    factor = cho_factor(scale[:, None] * normal * scale + held @ held.T, lower=True)
    once = cho_solve(factor, scale[:, None] * middle * scale)
    twice = scale[:, None] * cho_solve(factor, once.T) * scale
    return np.asarray(twice[width:, width:])
