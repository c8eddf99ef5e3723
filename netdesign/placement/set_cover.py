"""The fewest images that see every tag often enough: a set cover, solved to proof over candidate stations.

    minimise Σ x_c   subject to   Σ_c a_cg x_c >= min_rays for every tag g,   x_c in {0, 1}

The candidates lie on a Fibonacci lattice, far enough apart that any two of them intersect well. The answer seeds the
search and tells the user the least number of images these candidates allow. HiGHS is limited in nodes, never in
seconds: the same study gives the same answer on every machine.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from netdesign.model.arrays import Bools, Floats
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


def smallest_cover(viewpoints: Floats, sees: Bools, min_rays: int, most: int) -> Cover:
    """Return the smallest choice of candidates that sees every tag ``min_rays`` times.

    Args:
        viewpoints: (c, 2) candidates.  sees: (c, g).  most: largest admissible number of images.
    """
    none = Cover(viewpoints=np.zeros((0, 2)), candidates=len(viewpoints), least=most + 1)
    if len(viewpoints) < 2 or (sees.sum(axis=0) < min_rays).any():
        return none
    needed = np.unique(sees, axis=1).astype(np.float64)  # tags seen by the same candidates need one row
    answer = milp(
        np.ones(len(viewpoints)),
        integrality=np.ones(len(viewpoints)),
        bounds=Bounds(0, 1),
        constraints=[LinearConstraint(needed.T, lb=min_rays, ub=np.inf)],
        options={"node_limit": NODES},
    )
    if answer.x is None:
        return none
    chosen = viewpoints[np.round(answer.x).astype(bool)]
    bound = answer.mip_dual_bound if answer.mip_dual_bound is not None else 0.0
    return Cover(viewpoints=chosen, candidates=len(viewpoints), least=int(np.ceil(bound - 1e-6)))
