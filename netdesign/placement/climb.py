"""A network moved towards the study's [requirements], one camera at a time.

The climb works on proved sightings, scaled by what the exact network showed (``Load.scale``: exact over estimated, for
every requirement).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.results import DesignedNetwork
from netdesign.photogrammetry.limited_error import direct_covariance
from netdesign.photogrammetry.total_trace import propagated
from netdesign.placement.distances import (
    COVERAGE_FACTOR,
    SIGMA,
    distance_functions,
    distance_name,
    distance_u95,
    named_ends,
)
from netdesign.placement.network_problem import NetworkProblem, sighting_array

ROUNDS, MOVES = 80, 16  # of a climb, and networks tried in each
SAFE = 0.9995  # of the requirement, where a climb stops


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
    tour = tour_of(problem, viewpoints)
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


def tour_of(problem: NetworkProblem, viewpoints: Floats) -> float:
    """Return f2 of a network (k, 2)."""
    everything: Bools = np.ones((1, len(viewpoints)), np.bool_)
    return float(problem.evaluate(everything, viewpoints[None])[0][0, 1])
