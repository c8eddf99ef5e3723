"""Choosing one network of a Pareto front: the knee, or the cheapest that meets the requirements.

The knee. Each objective is taken as its logarithm (a factor of two in sigma is worth the same anywhere on the front)
and scaled so that the front spans [0, 1]: z. The plane z1 + z2 + z3 = 1 goes through the three networks that would be
best in one objective and as bad as the front gets in the others; the knee is the network farthest from it towards the
ideal point z = 0, at the distance (1 - z1 - z2 - z3) / sqrt(3). It is the bulge of I. Das, "On characterizing the
'knee' of the Pareto curve", Structural Optimization 18, 1999, with the axis directions fixed: the plane through the
extreme networks themselves degenerates when one network has both the shortest tour and the fewest images.
An objective that does not vary over the front says nothing and is left out.

Requirements. Cheapest means fewest images, then the shortest tour, then the smallest f1.
"""

import math
from dataclasses import dataclass

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Bools, Floats, frozen


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """An upper limit and what every network of the front has to set against it.

    Attributes:
        name: in words, "largest point sigma".  unit: of limit and values.
        values: (p,), one per network; inf where the network does not determine the quantity.
    """

    name: str
    unit: str
    limit: float
    values: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen("values", self.values, ("p",)))

    @property
    def met(self) -> Bools:
        """(p,) whether each network keeps the limit; equality keeps it."""
        return np.asarray(self.values <= self.limit)

    def __str__(self) -> str:
        return f"{self.name} of at most {self.limit:g} {self.unit}".rstrip()


def knee_distance(objectives: Floats) -> Floats:
    """Return (p,) the signed distance of networks with objectives (p, 3) > 0 from the plane of the module docstring."""
    objectives = np.asarray(objectives, dtype=np.float64)
    # A tour of length 0 (all images from one place) stands for "as short as the shortest other one, and shorter".
    positive = np.where(objectives > 0, objectives, np.nan)
    floor = np.nan_to_num(np.nanmin(positive, axis=0, initial=np.inf), posinf=1.0) * 0.5
    logs = np.log(np.where(objectives > 0, objectives, floor))
    low, high = logs.min(axis=0), logs.max(axis=0)
    varies = high - low > 1e-12
    scaled = np.where(varies, (logs - low) / np.where(varies, high - low, 1.0), 0.0)
    dimensions = max(int(varies.sum()), 1)
    return np.asarray((1.0 - scaled.sum(axis=1)) / np.sqrt(dimensions))


def knee(objectives: Floats, admissible: Bools | None = None) -> int:
    """Return the index of the knee among the admissible networks; a tie goes to the cheaper network.

    The scale is always that of the whole front, so that the limits of a user do not move the yardstick.

    Args:
        objectives: (p, 3) f1, f2, f3 in any units.  admissible: (p,), default all.
    """
    distance = knee_distance(objectives)
    order = np.lexsort((objectives[:, 0], objectives[:, 1], objectives[:, 2], -np.round(distance, 12)))
    allowed = np.ones(len(order), dtype=bool) if admissible is None else admissible
    return int(order[allowed[order]][0])


def cheapest(objectives: Floats, admissible: Bools) -> int:
    """Return the index of the admissible network with fewest images, then the shortest tour, then the smallest f1."""
    order = np.lexsort((objectives[:, 0], objectives[:, 1], objectives[:, 2]))
    return int(order[admissible[order]][0])


def admissible(requirements: list[Requirement], images: Floats) -> Bools:
    """Return (p,) which networks, of ``images`` (p,) each, meet every requirement.

    Raises:
        InfeasibleError: none does; names the requirement that binds and the best value that can be had.
    """
    met = np.ones(len(images), dtype=bool)
    for requirement in requirements:
        met &= requirement.met
    if not met.any():
        raise InfeasibleError(binding(requirements, images))
    return met


def binding(requirements: list[Requirement], images: Floats) -> str:
    """Return in words why no network, of ``images`` (p,) each, meets all requirements, and what would."""
    count = len(images)
    alone = [requirement for requirement in requirements if not requirement.met.any()]
    if alone:
        return f"none of the {count} networks of the front has a " + "; nor a ".join(
            f"{requirement}: the best has {_best(requirement.values, requirement.unit)}{_enough(requirement, images)}"
            for requirement in alone
        )
    # Each can be met, not all together: what would each have to give way to when the others stand?
    ways = []
    for requirement in requirements:
        others = np.ones(count, dtype=bool)
        for other in requirements:
            if other is not requirement:
                others &= other.met
        if others.any():
            best = _best(requirement.values[others], requirement.unit)
            ways.append(f"{requirement.name} {best} (asked: {requirement.limit:g})")
    together = " and a ".join(str(requirement) for requirement in requirements)
    counts = ", ".join(f"{int(requirement.met.sum())} have the {requirement.name}" for requirement in requirements)
    relief = f"; it can be had with {' or '.join(ways)}" if ways else "; more than one of them has to give way"
    return f"none of the {count} networks of the front has a {together} together ({counts}){relief}"


def _enough(requirement: Requirement, images: Floats) -> str:
    """Return about how many images a sigma needs: it falls with the square root of their number."""
    best = int(np.argmin(requirement.values))
    if requirement.unit != "µm" or not np.isfinite(requirement.values[best]):
        return ""
    needed = math.ceil(images[best] * (requirement.values[best] / requirement.limit) ** 2)
    return f" with {int(images[best])} images, about {needed} would be needed"


def _best(values: Floats, unit: str) -> str:
    best = float(values.min())
    return f"{round_up(best):g} {unit}".rstrip() if np.isfinite(best) else "no determined value"


def round_up(value: float, digits: int = 4) -> float:
    """Return ``value`` > 0 rounded up to significant digits: a limit that is printed must be one that can be met."""
    if value <= 0:
        return value
    step = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
    nearest = float(f"{value:.{digits}g}")
    return nearest if nearest >= value else float(f"{nearest + step:.{digits}g}")
