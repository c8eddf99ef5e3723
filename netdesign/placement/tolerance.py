"""Design to a tolerance: the cheapest network that keeps the study's [requirements], or what it would take.

The search knows f1, not the largest sigma of a point nor the uncertainty of a distance. Here networks of its archive
are carried on by a climb over single cameras: first until the requirements are met with as few images as possible, then
towards a shorter tour. The climb works on proved sightings, scaled by what the exact network showed (``Load.scale``:
exact over estimated, for every requirement); only exact values count in the end.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.results import DesignedNetwork
from netdesign.photogrammetry.limited_error import direct_covariance
from netdesign.photogrammetry.total_trace import propagated
from netdesign.placement.decide import round_up
from netdesign.placement.distances import (
    COVERAGE_FACTOR,
    SIGMA,
    distance_functions,
    distance_name,
    distance_u95,
    named_ends,
)
from netdesign.placement.network_problem import NetworkProblem, sighting_array
from netdesign.search.population import Population

ROUNDS, MOVES = 80, 16  # of a climb, and networks tried in each
NEAR = 2.5  # times the requirement: a size whose best network is farther away is not worth a climb
MOST_IMAGES = 60  # that are tried to say how many would be enough
TRIALS = 3  # exact checks of one size, each with the scale that the last one showed
SAFE = 0.9995  # of the requirement, where a climb stops

Exactly = Callable[[Floats], DesignedNetwork | str]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The cheapest admissible network, or None and a sentence that says what binds and what would satisfy it."""

    network: DesignedNetwork | None
    reason: str


@dataclass(frozen=True, kw_only=True)
class Load:
    """The requirements on precision, and how far networks use them up: 1 is the limit.

    Attributes:
        names: (r,) in words.  limits: (r,) m.  ends: (d, 2) object points of the distances, the last d requirements.
        functions: (3m, 7 + d) datum and distances as ``total_trace.propagated`` takes them.
        scale: (r,) exact value over the estimate of the climb.
    """

    problem: NetworkProblem
    names: tuple[str, ...]
    limits: Floats
    ends: Ints
    functions: Floats
    scale: Floats = field(default_factory=lambda: np.ones(0))

    @staticmethod
    def of(problem: NetworkProblem) -> "Load | None":
        """Return the study's requirements on precision, None when there are none."""
        asked = problem.task.study.requirements
        names, limits = [], []
        if asked.max_sigma_um is not None:
            names, limits = [SIGMA], [1e-6 * asked.max_sigma_um]
        ends = named_ends(problem.task)
        names += [distance_name(item.from_, item.to) for item in asked.distances]
        limits += [1e-6 * item.u95_um for item in asked.distances]
        if not names:
            return None
        return Load(
            problem=problem, names=tuple(names), limits=np.array(limits), ends=ends,
            functions=distance_functions(problem.task.scene.targets.points, ends), scale=np.ones(len(names)),
        )  # fmt: skip

    def estimated(self, viewpoints: Floats) -> Floats:
        """Return (r,) values in m of a network (k, 2) with sure sightings, not scaled; inf when not determined."""
        task, poses = self.problem.task, self.problem.poses(viewpoints)
        points, intrinsics = task.scene.targets.points, task.camera.intrinsics
        visible, sigma = self.problem.visible(viewpoints), sighting_array(task, poses)
        values = np.zeros(0)
        if len(self.ends):
            variances = propagated(poses, points, intrinsics, visible, sigma, self.functions)[1:]
            values = COVERAGE_FACTOR * np.sqrt(variances)
        if len(self.names) > len(self.ends):
            covariance = direct_covariance(poses, points, intrinsics, visible, sigma)
            values = np.append(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).max()), values)
        return values

    def exact(self, network: DesignedNetwork) -> Floats:
        """Return (r,) values in m of a finished network."""
        u95 = distance_u95(self.problem.task, network.world_from_cam, self.ends) if len(self.ends) else np.zeros(0)
        return u95 if len(self.names) == len(self.ends) else np.append(network.precision.sigma.max(), u95)

    def shares(self, viewpoints: Floats) -> Floats:
        """Return (r,) how much of each requirement a network (k, 2) uses up, estimated and scaled."""
        return np.asarray(self.scale * self.estimated(viewpoints) / self.limits)

    def used(self, viewpoints: Floats) -> float:
        """Return the largest share of a requirement that a network (k, 2) uses up."""
        return float(self.shares(viewpoints).max())

    def alone(self, row: int) -> Callable[[Floats], float]:
        """Return the share of one requirement as a function of the network, above 10 where another one is not kept."""

        def used(viewpoints: Floats) -> float:
            shares = self.shares(viewpoints)
            others = float(np.delete(shares, row).max(initial=0.0))
            return float(shares[row]) if others <= 1.0 else 10.0 + others

        return used


def cheapest_admissible(problem: NetworkProblem, members: Population, exactly: Exactly) -> Answer | None:
    """Return the network with fewest images, then the shortest tour, that keeps [requirements]; None without any.

    Args:
        members: of the archive, feasible.  exactly: as ``finish.Exact.network``.
    """
    load = Load.of(problem)
    if load is None:
        return None
    sizes = members.objectives[:, 2].astype(int)
    nearest: tuple[float, Floats] | None = None
    climbed: list[Floats] = []
    for size in np.unique(sizes).tolist():
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
            shortened = shorten(problem, load, min(meeting, key=lambda start: _tour(problem, start)))
            found = exactly(shortened)
            if isinstance(found, str):
                break
            values = load.exact(found)
            if (values <= load.limits).all():
                return Answer(network=found, reason=_met(load, values))
            load = replace(load, scale=np.maximum(load.scale, values / load.estimated(shortened)) * (1 + 1e-6))
            shares = np.array([load.used(start) for start in starts])
            best = int(shares.argmin())
    assert nearest is not None
    for start in climbed[-2:-6:-2]:  # a smaller network enlarged may end where the climb of a large one does not
        enlarged = _enlarged(problem, load, start, int(sizes.max()), exactly)
        if enlarged is not None and enlarged[1] is not None:
            return Answer(network=enlarged[1], reason=_met(load, load.exact(enlarged[1])))
    return Answer(network=None, reason=_unmet(problem, load, nearest[1], exactly))


def climb(problem: NetworkProblem, used: Callable[[Floats], float], viewpoints: Floats, rounds: int = ROUNDS) -> Floats:
    """Move single cameras of a network (k, 2) while the share ``used`` falls; stop once it is met."""
    share = used(viewpoints)
    rng = np.random.default_rng([problem.task.study.seed, len(viewpoints), 1])
    for _ in range(rounds):
        if share <= SAFE or not len(viewpoints):  # met, or existing stations only
            break
        trials, _, violation = _neighbours(problem, rng, viewpoints)
        for row in np.flatnonzero(violation <= 0).tolist():
            value = used(trials[row])
            if value < share:
                share, viewpoints = value, trials[row]
    return viewpoints


def shorten(problem: NetworkProblem, load: Load, viewpoints: Floats) -> Floats:
    """Move single cameras of an admissible network (k, 2) while the tour becomes shorter and everything stays met."""
    tour = _tour(problem, viewpoints)
    rng = np.random.default_rng([problem.task.study.seed, len(viewpoints), 2])
    for _ in range(ROUNDS if len(viewpoints) else 0):
        trials, length, violation = _neighbours(problem, rng, viewpoints)
        for row in np.argsort(length, kind="stable").tolist():
            if violation[row] <= 0 and length[row] < tour and load.used(trials[row]) <= SAFE:
                viewpoints, tour = trials[row], float(length[row])
                break
    return viewpoints


def _neighbours(problem: NetworkProblem, rng: np.random.Generator, viewpoints: Floats) -> tuple[Floats, Floats, Floats]:
    """(MOVES, k, 2) networks with one camera moved, their f2 and violation."""
    trials = np.tile(viewpoints, (MOVES, 1, 1))
    rows, moved = np.arange(MOVES), rng.integers(0, len(viewpoints), MOVES)
    stepped = problem.chromosomes.nudged(rng, trials[rows, moved])
    anywhere = problem.chromosomes.uniform(rng, (MOVES,))
    trials[rows, moved] = np.where((rng.random(MOVES) < 0.15)[:, None], anywhere, stepped)
    objectives, violation = problem.evaluate(np.ones(trials.shape[:2], np.bool_), trials)
    return trials, objectives[:, 1], violation


def _tour(problem: NetworkProblem, viewpoints: Floats) -> float:
    everything: Bools = np.ones((1, len(viewpoints)), np.bool_)
    return float(problem.evaluate(everything, viewpoints[None])[0][0, 1])


def _met(load: Load, values: Floats) -> str:
    return "; ".join(
        f"{name} {1e6 * value:.4g} µm of at most {1e6 * limit:g} µm"
        for name, value, limit in zip(load.names, values, load.limits, strict=True)
    )


def _unmet(problem: NetworkProblem, load: Load, viewpoints: Floats, exactly: Exactly) -> str:
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
    enough = None if ways else _enlarged(free, easier, viewpoints, MOST_IMAGES, checked)
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
    problem: NetworkProblem, load: Load, viewpoints: Floats, most: int, exactly: Exactly | None
) -> tuple[Floats, DesignedNetwork | None] | None:
    """The network with up to ``most`` images that meets the requirements; None when that is not enough.

    Up to 0.9 of what the square-root law asks for, images are added by f1; then where they lower the largest share.
    """
    stations = problem.candidates()
    stations = stations[:: max(1, len(stations) // 60)]
    fixed = len(problem.task.existing)
    likely = min(most, 0.9 * (fixed + len(viewpoints)) * load.used(viewpoints) ** 2)
    while fixed + len(viewpoints) < most:
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
    return f"{round_up(scale * _tour(problem, viewpoints)):g} {unit}"
