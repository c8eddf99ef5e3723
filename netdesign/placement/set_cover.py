"""The fewest images that see every tag often enough: a set cover, solved to proof over candidate stations.

    minimise Σ x_c   subject to   Σ_c a_cg x_c >= needed_g for every tag g,   x_c in {0, 1}

The candidates lie on a Fibonacci lattice, far enough apart that any two of them intersect well. The answer seeds the
search and tells the user the least number of images these candidates allow. HiGHS is limited in nodes, never in
seconds: the same study gives the same answer on every machine.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.frames import viewpoints_of

CANDIDATES = 600
NODES = 400


@dataclass(frozen=True, kw_only=True)
class Cover:
    """The smallest cover found.

    Attributes:
        viewpoints: (k, 2) rad; empty when the candidates admit no cover.
        candidates: how many stations there were to choose from.
        least: proven lower bound on the number of images over these candidates; k when the cover is optimal.
    """

    viewpoints: Floats
    candidates: int
    least: int


def lattice(count: int) -> Floats:
    """Return about ``count`` viewpoints (c, 2), spread evenly over the sphere (Fibonacci lattice)."""
    step = np.arange(count) + 0.5
    height = 1.0 - 2.0 * step / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * step
    flat = np.sqrt(1.0 - height**2)
    return viewpoints_of(np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1))


def smallest_cover(viewpoints: Floats, sees: Bools, needed: Ints, most: int) -> Cover:
    """Return the smallest choice of candidates that sees every tag ``needed`` times.

    Args:
        viewpoints: (c, d) candidates.  sees: (c, g).  needed: (g,) rays.  most: largest admissible number of images.
    """
    none = Cover(viewpoints=viewpoints[:0], candidates=len(viewpoints), least=most + 1)
    if not needed.any():
        return replace(none, least=0)
    if len(viewpoints) < 2 or (sees.sum(axis=0) < needed).any():
        return none
    # Tags seen by the same candidates need one row.
    rows = np.unique(np.vstack([sees, needed])[:, needed > 0], axis=1).astype(np.float64)
    answer = milp(
        np.ones(len(viewpoints)),
        integrality=np.ones(len(viewpoints)),
        bounds=Bounds(0, 1),
        constraints=[LinearConstraint(rows[:-1].T, lb=rows[-1], ub=np.inf)],
        options={"node_limit": NODES},
    )
    if answer.x is None:
        return none
    chosen = viewpoints[np.round(answer.x).astype(bool)]
    bound = answer.mip_dual_bound if answer.mip_dual_bound is not None else 0.0
    return Cover(viewpoints=chosen, candidates=len(viewpoints), least=int(np.ceil(bound - 1e-6)))
