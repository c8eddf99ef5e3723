"""Design to a tolerance: the cheapest network that keeps the study's [requirements], or what it would take.

The search knows f1, not the largest sigma of a point nor the uncertainty of a distance. Here networks of its archive
are carried on by a climb over single cameras: first until the requirements are met with as few images as possible, then
towards a shorter tour. Only exact values count in the end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.progress import Progress
from netdesign.model.results import DesignedNetwork
from netdesign.placement.climb import ROUNDS, SAFE, Load, climb, shorten, tour_of
from netdesign.placement.decide import round_up
from netdesign.placement.network_problem import NetworkProblem
from netdesign.search.population import Population

NEAR = 2.5  # times the requirement: a size whose best network is farther away is not worth a climb
MOST_IMAGES = 60  # that are tried to say how many would be enough
TRIALS = 3  # exact checks of one size, each with the scale that the last one showed

Exactly = Callable[[Floats], DesignedNetwork | str]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The cheapest admissible network, or None and a sentence that says what binds and what would satisfy it."""

    network: DesignedNetwork | None
    reason: str


def cheapest_admissible(
    problem: NetworkProblem, members: Population, exactly: Exactly, progress: Progress
) -> Answer | None:
    """Return the network with fewest images, then the shortest tour, that keeps [requirements]; None without any.

    Args:
        members: of the archive, feasible.  exactly: as ``finish.Exact.network``.
        progress: sizes looked at, then images added.
    """
    load = Load.of(problem)
    if load is None:
        return None
    sizes = members.objectives[:, 2].astype(int)
    nearest: tuple[float, Floats] | None = None
    climbed: list[Floats] = []
    different = np.unique(sizes).tolist()
    for number, size in enumerate(different):
        progress("requirements", number, len(different), f"{size} images")
        layer = members.take(sizes == size)
        rows = np.unique(np.round(np.linspace(0, len(layer) - 1, min(len(layer), 40))).astype(int))
        starts = [layer.genes[row][layer.bits[row]] for row in rows.tolist()]
        shares = np.array([load.used(start) for start in starts])
        best = int(shares.argmin())
        last = size == sizes.max()
        if nearest is None or shares[best] < nearest[0]:
            nearest = float(shares[best]), starts[best]
        if shares[best] > NEAR and not last:
            continue
        for _ in range(TRIALS):
            viewpoints = climb(problem, load.used, starts[best])
            climbed.append(viewpoints)
            share = load.used(viewpoints)
            if share < nearest[0]:
                nearest = share, viewpoints
            if share > 1.0:
                break
            meeting = [start for start, value in zip(starts, shares, strict=True) if value <= SAFE] or [viewpoints]
            shortened = shorten(problem, load, min(meeting, key=lambda start: tour_of(problem, start)))
            found = exactly(shortened)
            if isinstance(found, str):
                break
            values = load.exact(found)
            if (values <= load.limits).all():
                progress("requirements", len(different), len(different))
                return Answer(network=found, reason=_met(load, values))
            load = replace(load, scale=np.maximum(load.scale, values / load.estimated(shortened)) * (1 + 1e-6))
            shares = np.array([load.used(start) for start in starts])
            best = int(shares.argmin())
    progress("requirements", len(different), len(different))
    assert nearest is not None
    for start in climbed[-2:-6:-2]:  # a smaller network enlarged may end where the climb of a large one does not
        enlarged = _enlarged(problem, load, start, int(sizes.max()), exactly, progress)
        progress("more images", 1, 1)
        if enlarged is not None and enlarged[1] is not None:
            return Answer(network=enlarged[1], reason=_met(load, load.exact(enlarged[1])))
    return Answer(network=None, reason=_unmet(problem, load, nearest[1], exactly, progress))


def _met(load: Load, values: Floats) -> str:
    return "; ".join(
        f"{name} {1e6 * value:.4g} µm of at most {1e6 * limit:g} µm"
        for name, value, limit in zip(load.names, values, load.limits, strict=True)
    )


def _unmet(problem: NetworkProblem, load: Load, viewpoints: Floats, exactly: Exactly, progress: Progress) -> str:
    """Return which requirement binds, the best that can be had, and what would satisfy it."""
    found = exactly(viewpoints)
    values = load.scale * load.estimated(viewpoints) if isinstance(found, str) else load.exact(found)
    fixed = len(problem.task.existing)
    size = fixed + len(viewpoints)
    best = _each_alone(problem, load, viewpoints) if len(load.names) > 1 else {}
    lead = "with the others kept, " if best else ("together, " if len(load.names) > 1 else "")
    if not best:
        over = values > load.limits
        best = (
            dict(enumerate(values)) if not over.any() else {row: values[row] for row in np.flatnonzero(over).tolist()}
        )
    parts = lead + (" or " if lead.startswith("with") else " and ").join(
        f"{load.names[row]} is at best {round_up(1e6 * value):g} µm (required {1e6 * load.limits[row]:g})"
        for row, value in best.items()
    )
    free = problem.without_tour_limit()
    easier = replace(load, problem=free, scale=np.maximum(load.scale, values / load.estimated(viewpoints)))
    ways = []
    if free is not problem:
        longer = climb(free, easier.used, viewpoints)
        if easier.used(longer) <= 1.0:
            ways.append(f"a tour of {_length(free, longer)} would reach it")
    checked = exactly if free is problem else None  # the exact check keeps the tour's limit
    enough = None if ways else _enlarged(free, easier, viewpoints, MOST_IMAGES, checked, progress)
    progress("more images", 1, 1)
    if enough is not None:
        ways.append(f"{fixed + len(enough[0])} images would reach it, on a tour of {_length(free, enough[0])}")
    elif not ways:
        ways.append(f"{MOST_IMAGES} images would not reach it")
    within = " within requirements.max_tour" if free is not problem else ""
    return f"no network meets the requirements: {parts}{within} with {size} images; {' or '.join(ways)}"


def _each_alone(problem: NetworkProblem, load: Load, viewpoints: Floats) -> dict[int, float]:
    """Return for each requirement the best value (m) found with all others kept; only those that exceed it then."""
    found = {}
    for row in range(len(load.names)):
        used = load.alone(row)
        share = used(climb(problem, used, viewpoints))
        if 1.0 < share < 10.0:
            found[row] = share * float(load.limits[row])
    return found


def _enlarged(
    problem: NetworkProblem,
    load: Load,
    viewpoints: Floats,
    most: int,
    exactly: Exactly | None,
    progress: Progress,
) -> tuple[Floats, DesignedNetwork | None] | None:
    """The network with up to ``most`` images that meets the requirements; None when that is not enough.

    Up to 0.9 of what the square-root law asks for, images are added by f1; then where they lower the largest share.
    """
    stations = problem.candidates()
    stations = stations[:: max(1, len(stations) // 60)]
    fixed = len(problem.task.existing)
    likely = min(most, 0.9 * (fixed + len(viewpoints)) * load.used(viewpoints) ** 2)
    first = fixed + len(viewpoints)
    while fixed + len(viewpoints) < most:
        progress("more images", fixed + len(viewpoints) - first, most - first, f"{fixed + len(viewpoints)} images")
        trials = np.concatenate([np.tile(viewpoints, (len(stations), 1, 1)), stations[:, None]], axis=1)
        f1, violation = problem.limited_scores(np.ones(trials.shape[:2], np.bool_), trials)
        near = fixed + len(viewpoints) + 1 >= likely
        shares = np.round([load.used(trial) for trial in trials], 3) if near else np.zeros(len(trials))
        viewpoints = trials[int(np.lexsort((f1, shares, violation))[0])]
        if near:
            viewpoints = climb(problem, load.used, viewpoints, ROUNDS // 2)
            if load.used(viewpoints) > 1.0:
                continue
            if exactly is None:
                return viewpoints, None
            found = exactly(viewpoints)
            if isinstance(found, str):
                continue
            values = load.exact(found)
            if (values <= load.limits).all():
                return viewpoints, found
            load = replace(load, scale=np.maximum(load.scale, values / load.estimated(viewpoints)) * (1 + 1e-6))
    return None


def _length(problem: NetworkProblem, viewpoints: Floats) -> str:
    unit, scale = {"workspace": ("mm", 1e3), "joint": ("rad", 1.0), "time": ("s", 1.0)}[problem.task.study.motion]
    return f"{round_up(scale * tour_of(problem, viewpoints)):g} {unit}"
