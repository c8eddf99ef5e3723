"""The coupling B = N_pp⁻¹ N_pc of points and camera side, stored where it is not zero.

A point is coupled to the images that see it and to their cameras only. Thirty thousand points and a hundred images
would fill a gigabyte as a full (3m, W) matrix; stored by point they fill some ten megabytes.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import entry


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """B (3m, W), its columns listed point by point.

    Attributes:
        start: (m + 1,) where each point's entries begin.  column: (e,) camera-side unknown, distinct within a point.
        value: (e, 3) entries of the point's three rows in that column.  width: W.
    """

    start: Ints
    column: Ints
    value: Floats
    width: int

    @property
    def point(self) -> Ints:
        """(e,) point of each entry."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def dense(self) -> Floats:
        """Return B (3m, W) in full."""
        full = np.zeros((len(self.start) - 1, 3, self.width))
        full[self.point, :, self.column] = self.value
        return full.reshape(-1, self.width)

    def times(self, vector: Floats) -> Floats:
        """Return B c (m, 3) of a camera-side vector (W,)."""
        result = np.zeros((len(self.start) - 1, 3))
        product = self.value * vector[self.column, None]
        for axis in range(3):
            result[:, axis] = np.bincount(self.point, product[:, axis], len(result))
        return result

    def under(self, operator: Floats) -> Floats:
        """Return A B (d, W) of an operator A (d, 3m) on the points."""
        count, point = len(self.start) - 1, self.point
        result = np.zeros((len(operator), self.width))
        for row, weights in zip(result, operator.reshape(len(operator), count, 3), strict=True):
            row[:] = np.bincount(self.column, (weights[point] * self.value).sum(axis=1), self.width)
        return result

    def spread(self, covariance: Floats, other: Floats) -> tuple[Floats, Floats]:
        """Return the diagonal blocks of B C Bᵀ (m, 3, 3) and the products B Oᵀ (m, 3, d).

        Args:
            covariance: C (W, W), symmetric.  other: O (d, W).
        """
        blocks, products = _spread(
            self.start, self.column, self.value, np.ascontiguousarray(covariance), np.ascontiguousarray(other.T)
        )
        return blocks, products

    def with_kept(self, kept_start: Ints) -> "Coupling":
        """Return B extended by the points that stand on the camera side: p = -B c, so their rows are -I.

        Args:
            kept_start: (m,) first column of each such point, -1 for the others, whose entries stay.
        """
        kept = np.flatnonzero(kept_start >= 0)
        if len(kept) == 0:
            return self
        point = np.r_[self.point, np.repeat(kept, 3)]
        column = np.r_[self.column, (kept_start[kept][:, None] + np.arange(3)).ravel()]
        value = np.vstack([self.value, np.tile(-np.eye(3), (len(kept), 1))])
        order = np.argsort(point, kind="stable")
        start = np.searchsorted(point[order], np.arange(len(self.start)))
        return Coupling(start=start, column=column[order], value=value[order], width=self.width)


@entry()
def _spread(
    start: Ints, column: Ints, value: Floats, covariance: Floats, other: Floats
) -> tuple[Floats, Floats]:  # pragma: no cover - compiled
    count, size = start.shape[0] - 1, other.shape[1]
    blocks = np.zeros((count, 3, 3))
    products = np.zeros((count, 3, size))
    for point in range(count):
        for a in range(start[point], start[point + 1]):
            row = column[a]
            s0 = s1 = s2 = 0.0
            for b in range(start[point], start[point + 1]):
                element = covariance[row, column[b]]
                s0 += element * value[b, 0]
                s1 += element * value[b, 1]
                s2 += element * value[b, 2]
            for axis in range(3):
                blocks[point, axis, 0] += value[a, axis] * s0
                blocks[point, axis, 1] += value[a, axis] * s1
                blocks[point, axis, 2] += value[a, axis] * s2
                for d in range(size):
                    products[point, axis, d] += value[a, axis] * other[row, d]
    return blocks, products
