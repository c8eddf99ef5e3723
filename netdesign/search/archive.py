"""The archive: the non-dominated networks of every size, thinned so that neighbours differ by at least epsilon.

The last objective is the size; within one size the front is a staircase in the first two. A network of one size stays
although a smaller one dominates it: it is a stepping stone, and the final front is cut from all sizes at the end.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.search.population import Floats, Ints, Population, joined
from netdesign.search.selection import first_of_runs

EPSILON = 0.01
"""Relative width of a box in either objective; without thinning an archive fills up with near-copies."""


@dataclass(frozen=True, kw_only=True)
class Archive:
    """Feasible members, sorted by size, then by the first objective; each size a strict staircase."""

    members: Population

    def __len__(self) -> int:
        return len(self.members)

    @property
    def sizes(self) -> Ints:
        """(N,) the last objective as whole numbers."""
        return self.members.objectives[:, -1].astype(np.int64)

    def with_rows(self, candidates: Population) -> "Archive":
        """Return the archive after feasible candidates have been offered to it."""
        everything = joined([self.members, candidates])
        return Archive(members=everything.take(staircases(everything.objectives, EPSILON)))


def empty_archive(slots: int, genes: int, objectives: int) -> Archive:
    """Return an archive without members, for chromosomes of that shape."""
    return Archive(
        members=Population(
            bits=np.zeros((0, slots), dtype=np.bool_),
            genes=np.zeros((0, slots, genes)),
            objectives=np.zeros((0, objectives)),
            violation=np.zeros(0),
        )
    )


def staircases(objectives: Floats, epsilon: float) -> Ints:
    """Return the rows to keep of objectives (N, 3): for each size the non-dominated ones, thinned, sorted.

    Both ends of a staircase stay. Of the rows that fall into one box of relative width ``epsilon`` the one nearest to
    the origin in logarithms stays; ties go to the earlier row, so that the result depends on the order of arrival only.
    """
    if len(objectives) == 0:
        return np.zeros(0, dtype=np.int64)
    order = np.lexsort((objectives[:, 1], objectives[:, 0], objectives[:, 2]))
    layer = np.cumsum(first_of_runs(objectives[order, 2])[0]) - 1
    # Ranks that no value of an earlier layer falls below: one running minimum serves all layers.
    second = np.unique(objectives[order, 1], return_inverse=True)[1] - len(order) * layer
    keep = np.ones(len(order), dtype=np.bool_)
    keep[1:] = second[1:] < np.minimum.accumulate(second)[:-1]
    order, layer = order[keep], layer[keep]
    if epsilon <= 0:
        return order
    logs = np.log(np.maximum(objectives[order, :2], 1e-300))
    boxes = np.floor(logs / np.log1p(epsilon)).astype(np.int64)
    nearness = logs.sum(axis=1)
    starts, ends = first_of_runs(layer)
    chosen = starts | ends
    starts[1:] |= (boxes[1:, 0] != boxes[:-1, 0]) | (boxes[1:, 1] != boxes[:-1, 1])
    box = np.cumsum(starts) - 1
    best = np.lexsort((nearness, box))
    chosen[best[first_of_runs(box[best])[0]]] = True
    return order[chosen]


def non_dominated(objectives: Floats) -> Ints:
    """Return the rows (sorted by index) of objectives (N, 3) that no other row dominates; of equal rows the first."""
    order = np.lexsort((objectives[:, 1], objectives[:, 0], objectives[:, 2]))
    kept: list[int] = []
    for row in order.tolist():
        if not (objectives[kept] <= objectives[row]).all(axis=1).any():
            kept.append(row)
    return np.array(sorted(kept), dtype=np.int64)
