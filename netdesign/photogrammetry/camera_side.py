"""The camera side of the total trace, compiled: the datum's rows of the poses, and inverses by Cholesky factors."""

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.compiled import FAST, entry

PIVOT = 1e-12  # of the scaled normal matrix with unit diagonal: below it the network is not determined


@entry()
def datum_rows(world_from_cam: Floats, points: Floats) -> Floats:
    """Return the camera rows (6n, 7) of the datum's null space about the points' centroid."""
    images, count = world_from_cam.shape[0], points.shape[0]
    centre = np.zeros(3)
    for j in range(count):
        for axis in range(3):
            centre[axis] += points[j, axis] / count
    gauge = np.zeros((6 * images, 7))
    for i in range(images):
        t0, t1, t2 = (
            world_from_cam[i, 0, 3] - centre[0],
            world_from_cam[i, 1, 3] - centre[1],
            world_from_cam[i, 2, 3] - centre[2],
        )
        for a in range(3):
            r0, r1, r2 = world_from_cam[i, 0, a], world_from_cam[i, 1, a], world_from_cam[i, 2, a]
            row = 6 * i + a
            gauge[row, 3], gauge[row, 4], gauge[row, 5] = r0, r1, r2
            row += 3
            gauge[row, 0], gauge[row, 1], gauge[row, 2] = r0, r1, r2
            gauge[row, 3], gauge[row, 4], gauge[row, 5] = r2 * t1 - r1 * t2, r0 * t2 - r2 * t0, r1 * t0 - r0 * t1
            gauge[row, 6] = r0 * t0 + r1 * t1 + r2 * t2
    for g in range(7):  # comparable columns before the orthogonalisation
        size = np.sqrt((gauge[:, g] ** 2).sum())
        if size > 0:
            gauge[:, g] /= size
    return gauge


@entry()
def orthonormalise(gauge: Floats, scale: Floats) -> bool:
    """Divide the rows by ``scale`` and make the columns orthonormal in place (Gram-Schmidt, twice)."""
    width = gauge.shape[0]
    for a in range(width):
        for g in range(7):
            gauge[a, g] /= scale[a]
    for g in range(7):
        before = np.sqrt((gauge[:, g] ** 2).sum())
        for _ in range(2):
            for h in range(g):
                product = 0.0
                for a in range(width):
                    product += gauge[a, g] * gauge[a, h]
                for a in range(width):
                    gauge[a, g] -= product * gauge[a, h]
        size = np.sqrt((gauge[:, g] ** 2).sum())
        if not size > 1e-10 * before:
            return False
        for a in range(width):
            gauge[a, g] /= size
    return True


@entry(fastmath=FAST)
def invert(matrix: Floats) -> bool:
    """Replace the lower triangle of a positive definite matrix by that of its inverse; False if a pivot vanishes."""
    width = matrix.shape[0]
    for j in range(width):
        for i in range(j, width):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not value > PIVOT:
                    return False
                matrix[j, j] = np.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    factor = np.zeros((width, width))  # L⁻¹ transposed: rows contiguous in the sums below
    for j in range(width):
        factor[j, j] = 1.0 / matrix[j, j]
        for i in range(j + 1, width):
            value = 0.0
            for k in range(j, i):
                value -= matrix[i, k] * factor[j, k]
            factor[j, i] = value / matrix[i, i]
    for i in range(width):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, width):
                value += factor[i, k] * factor[j, k]
            matrix[i, j] = value
    return True


@entry()
def image_by_image(schur: Floats, spread: Floats) -> float:
    """Return Σ_i tr(S_ii⁻¹ (BᵀB)_ii) from the lower triangles of S and BᵀB; inf when an image is not determined."""
    value = 0.0
    block = np.zeros((6, 6))
    scale = np.zeros(6)
    for first in range(0, len(schur), 6):
        for a in range(6):
            if not schur[first + a, first + a] > 0.0:
                return np.inf
            scale[a] = 1.0 / np.sqrt(schur[first + a, first + a])
        for a in range(6):
            for b in range(a + 1):
                block[a, b] = schur[first + a, first + b] * scale[a] * scale[b]
        if not invert(block):
            return np.inf
        for a in range(6):
            for b in range(a + 1):
                twice = 1.0 if a == b else 2.0
                value += twice * block[a, b] * scale[a] * scale[b] * spread[first + a, first + b]
    return value
