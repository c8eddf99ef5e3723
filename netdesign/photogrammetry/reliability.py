"""Reliability: what the adjustment can check, and what an undetected error does.

For image point k with whitened derivatives of the camera side J and of the point A, Red = I - H (2, 2) is its block of
the redundancy matrix, H the hat matrix:

    H = E S⁻ Eᵀ + A D Aᵀ,   E = J - A B          (independent of the datum)
    redundancy numbers  r = diag Red             Σ over everything observed = redundancy of the adjustment
    minimal detectable error  = delta0 σ / sqrt(r)        delta0 = 4.13: 0.1 % significance, 80 % power
    w-test with 2 degrees of freedom  T = eᵀ Red⁻¹ e,  e the whitened residual, chi² (2) without an error
    external reliability: the largest shift, in its own standard deviations, that an undetected error of that size
    gives any unknown, delta0 sqrt((1 - r) / r)

Sources: W. Baarda, A testing procedure for use in geodetic networks, 1968; W. Förstner, PERS 51(8), 1985.
"""

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import entry
from netdesign.photogrammetry.normals import Linearised, Reduced

DELTA0 = 4.13


def redundancy_matrices(linearised: Linearised, reduced: Reduced, camera_inverse: Floats) -> Floats:
    """Return Red (k, 2, 2) of every image point, in whitened coordinates."""
    return np.asarray(
        _redundancy(
            linearised.columns,
            linearised.camera,
            np.where(linearised.eliminated[linearised.point][:, None, None], linearised.point_part, 0.0),
            linearised.point,
            reduced.inverse,
            reduced.coupling.start,
            reduced.coupling.column,
            reduced.coupling.value,
            np.ascontiguousarray(camera_inverse),
        )
    )


@entry()
def _redundancy(
    columns: Ints,
    camera: Floats,
    point_part: Floats,
    point: Ints,
    inverse: Floats,
    start: Ints,
    column: Ints,
    value: Floats,
    camera_inverse: Floats,
) -> Floats:  # pragma: no cover - compiled
    """E has entries at every camera-side unknown that the point's other images touch: gather those."""
    count, slots = columns.shape
    width = camera_inverse.shape[0]
    result = np.zeros((count, 2, 2))
    place = np.full(width, -1, dtype=np.int64)
    touched = np.empty(width, dtype=np.int64)
    effect = np.zeros((2, width))  # by place in ``touched``
    for k in range(count):
        p = point[k]
        used = 0
        for e in range(start[p], start[p + 1]):
            place[column[e]] = used
            touched[used] = column[e]
            for row in range(2):
                effect[row, used] = -(
                    point_part[k, row, 0] * value[e, 0]
                    + point_part[k, row, 1] * value[e, 1]
                    + point_part[k, row, 2] * value[e, 2]
                )
            used += 1
        for a in range(slots):
            c = columns[k, a]
            if c < 0:
                continue
            if place[c] < 0:
                place[c] = used
                touched[used] = c
                effect[0, used] = effect[1, used] = 0.0
                used += 1
            effect[0, place[c]] += camera[k, 0, a]
            effect[1, place[c]] += camera[k, 1, a]
        h00 = h01 = h11 = 0.0
        for a in range(used):
            s0 = s1 = 0.0
            for b in range(used):
                element = camera_inverse[touched[a], touched[b]]
                s0 += element * effect[0, b]
                s1 += element * effect[1, b]
            h00 += effect[0, a] * s0
            h01 += effect[0, a] * s1
            h11 += effect[1, a] * s1
            place[touched[a]] = -1
        for a in range(3):
            for b in range(3):
                d = inverse[p, a, b]
                h00 += point_part[k, 0, a] * d * point_part[k, 0, b]
                h01 += point_part[k, 0, a] * d * point_part[k, 1, b]
                h11 += point_part[k, 1, a] * d * point_part[k, 1, b]
        result[k, 0, 0], result[k, 1, 1] = 1.0 - h00, 1.0 - h11
        result[k, 0, 1], result[k, 1, 0] = -h01, -h01
    return result


def redundancy_numbers(redundancy: Floats) -> Floats:
    """Return (k, 2): share of an error in each (whitened) image coordinate that its residual shows."""
    return np.ascontiguousarray(np.diagonal(redundancy, axis1=1, axis2=2))


def w_statistic(whitened_residual: Floats, redundancy: Floats) -> Floats:
    """Return T (k,): chi² with 2 degrees of freedom if the image point is free of gross errors.

    0 where the redundancy matrix is singular (nothing checks the point): such an error cannot be found.
    """
    values, vectors = np.linalg.eigh(redundancy)
    turned = np.einsum("kij,ki->kj", vectors, whitened_residual)
    # A direction with next to no redundancy has a residual of rounding errors only.
    checked = values > 1e-8
    return np.asarray((np.where(checked, turned, 0.0) ** 2 / np.where(checked, values, 1.0)).sum(axis=1))


def minimal_detectable_error(numbers: Floats, sigma_px: Floats) -> Floats:
    """Return the smallest gross error (k, 2) px that the test finds with 80 % power; inf where nothing checks it.

    Args:
        numbers: (k, 2) redundancy numbers.  sigma_px: (k, 2) of the image coordinates.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(DELTA0 * sigma_px / np.sqrt(np.maximum(numbers, 0.0)))


def external_reliability(numbers: Floats) -> Floats:
    """Return the largest effect (k, 2) of an undetected error on any unknown, in its standard deviations."""
    clipped = np.clip(numbers, 0.0, 1.0)
    with np.errstate(divide="ignore"):
        return np.asarray(DELTA0 * np.sqrt((1.0 - clipped) / clipped))
