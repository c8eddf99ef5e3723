"""Stations that are not on one sphere: a range of radii, an ellipsoid, a box, or existing ones anywhere.

No map of the visible can be drawn once and for all here: every station is looked at when it first appears
(``known_stations``), and limited propagation adds up what the images contribute.
"""

from dataclasses import dataclass, replace

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.photogrammetry.connectivity import loose_images
from netdesign.photogrammetry.limited_error import WEAK, variances_of
from netdesign.placement.distances import named_ends
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.evaluation import excess
from netdesign.placement.known_stations import KnownStations, Station
from netdesign.placement.network_problem import ADDITIONS, MOVES, REMOVALS, TELEPORTS, NetworkProblem
from netdesign.placement.preparation import datum_gauge, demanded_cover, free_slots, hypervolume_scale, on_sphere
from netdesign.placement.problem import Problem
from netdesign.placement.set_cover import CANDIDATES, Cover
from netdesign.search.population import Population

MM = 1e-3
ROUNDS = 5  # of the local search: a fifth of the moves at once, the best of them is where the next start


def problem_of(task: Task, progress: Progress = silent) -> NetworkProblem:
    """Prepare a study: on the fast way where all stations lie on the viewing sphere, else station by station.

    Raises:
        InputError: [requirements] names unknown points, or existing stations do not fit the study.
        InfeasibleError: some tag can be seen from nowhere, or no station sees enough.
    """
    if task.sphere.depth is not None or not on_sphere(task):
        return FreeProblem.build(task, progress)
    problem = Problem.build(task, progress)
    if not problem.reachable(problem.pinned).all():  # at the edge of what a map can tell
        return FreeProblem.build(task, progress)
    return problem


@dataclass(frozen=True, kw_only=True)
class FreeProblem(NetworkProblem):
    """A study with stations anywhere in the admissible body.

    Attributes:
        stations: what is known of them.  fixed: the existing ones.  limit: longest admissible tour, in the unit of f2.
    """

    stations: KnownStations
    fixed: tuple[Station, ...]
    limit: float

    @staticmethod
    def build(task: Task, progress: Progress = silent) -> "FreeProblem":
        """Prepare a study; see ``problem_of``."""
        named_ends(task)
        slots = free_slots(task)
        progress("set cover", 0, 1)
        known, asked = KnownStations.build(task), task.study.requirements.max_tour
        unit = MM if task.study.motion == "workspace" else 1.0

        def tours(networks: Floats) -> Floats:
            return np.array([known.tour(known.of(viewpoints))[0] for viewpoints in networks])

        empty = Cover(viewpoints=np.zeros((0, task.sphere.genes)), candidates=0, least=0)
        problem = FreeProblem(
            task=task, chromosomes=Chromosomes(sphere=task.sphere, slots=slots), cover=empty,
            scale=hypervolume_scale(task, slots, tours), gauge=datum_gauge(task), joint_map=known.joint_map,
            stations=known, fixed=known.existing(), limit=np.inf if asked is None else unit * asked,
        )  # fmt: skip
        stations = problem.candidates()
        already = problem.existing_sees.sum(axis=0)
        cover = demanded_cover(task, stations, problem.sees(stations), already, slots, None)
        progress("set cover", 1, 1)
        return replace(problem, cover=cover)

    def evaluate(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return objectives (P, 3) in SI units and violation (P,) of chromosomes."""
        objectives, violation = self._evaluated(bits, genes, tours=True)
        self.propagate_further(bits, genes, objectives, violation)
        return objectives, violation

    def limited_scores(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return f1 of the limited propagation and violation, whatever the tour and the criterion's propagation."""
        objectives, violation = self._evaluated(bits, genes, tours=False)
        return objectives[:, 0], violation

    def candidates(self) -> Floats:
        """Return viewpoints (c, d) all over the admissible set, within reach, that see enough for an image."""
        viewpoints = self.chromosomes.spread(CANDIDATES)
        viewpoints = viewpoints[self.reachable(viewpoints)]
        enough = self.sees(viewpoints).sum(axis=1) * CORNERS_PER_TAG >= max(self.task.limits.min_points_per_image, 1)
        return np.asarray(viewpoints[enough])

    def sees(self, viewpoints: Floats) -> Bools:
        """Return (k, g) the tags that are seen from viewpoints (k, d): exact."""
        found = [station.sees for station in self.stations.of(viewpoints)]
        return np.array(found, np.bool_).reshape(len(found), len(self.task.scene.targets.ids))

    def reachable(self, viewpoints: Floats) -> Bools:
        """Return (k,) whether the arm can take viewpoints (k, d); all of them when motion is in the workspace."""
        if self.joint_map is None:
            return np.ones(len(viewpoints), np.bool_)
        return np.array([len(station.joints) > 0 for station in self.stations.of(viewpoints)], np.bool_)

    def without_tour_limit(self) -> "FreeProblem":
        """Return the problem without requirements.max_tour; itself when there is none."""
        if not np.isfinite(self.limit):
            return self
        return replace(self, limit=np.inf)

    @property
    def longest(self) -> float:
        """The longest admissible tour, inf when there is no limit."""
        return self.limit

    @property
    def existing_sees(self) -> Bools:
        """(e, g) the tags that the existing stations see."""
        count = len(self.task.scene.targets.ids)
        return np.array([station.sees for station in self.fixed], np.bool_).reshape(-1, count)

    def improve(self, rng: np.random.Generator, members: Population, preference: Floats) -> Population:
        """Return evaluated neighbours of feasible members: rounds of moves, each from the best of the last one."""
        tried: list[tuple[Bools, Floats, Floats, Floats]] = []
        slots = self.chromosomes.slots
        here = [genes[bits] for genes, bits in zip(members.genes, members.bits, strict=True)]
        value = _preferred(preference, members.objectives)

        def evaluated(networks: list[Floats]) -> tuple[Floats, Floats]:
            genes = np.zeros((len(networks), slots, self.task.sphere.genes))
            for row, network in enumerate(networks):
                genes[row, : len(network)] = network
            bits = np.arange(slots) < np.array([len(network) for network in networks], np.int64)[:, None]
            objectives, violation = self.evaluate(bits, genes)
            tried.append((bits, genes, objectives, violation))
            return objectives, violation

        for _ in range(ROUNDS):
            owner = np.repeat(np.arange(len(here)), MOVES // ROUNDS)
            trials = [self._moved(rng, here[member]) for member in owner.tolist()]
            objectives, violation = evaluated(trials)
            values, good = np.full(len(trials), np.inf), violation <= 0
            values[good] = _preferred(preference[owner][good], objectives[good])
            for member in range(len(here)):
                rows = np.flatnonzero(owner == member)
                best = int(rows[np.argmin(values[rows])])
                if values[best] < value[member]:
                    value[member], here[member] = values[best], trials[best]
        least = max(0, 2 - len(self.fixed))
        changed = []
        for network in here:
            for _ in range(REMOVALS if len(network) else 0):
                changed.append(np.delete(network, rng.integers(len(network)), axis=0))
            new = self.chromosomes.uniform(rng, (ADDITIONS,))
            changed += [np.concatenate([network, station[None]]) for station in new]
        changed = [network for network in changed if least <= len(network) <= slots]
        if changed:
            evaluated(changed)
        parts = [np.concatenate(column) for column in zip(*tried, strict=True)]
        return Population(bits=parts[0], genes=parts[1], objectives=parts[2], violation=parts[3])

    def _moved(self, rng: np.random.Generator, network: Floats) -> Floats:
        """One station of a network (k, d) nudged or sent anywhere."""
        if not len(network):
            return network
        moved, camera = network.copy(), rng.integers(len(network))
        anywhere = rng.random() < TELEPORTS
        moved[camera] = self.chromosomes.uniform(rng, ()) if anywhere else self.chromosomes.nudged(rng, network[camera])
        return moved

    def _evaluated(self, bits: Bools, genes: Floats, tours: bool) -> tuple[Floats, Floats]:
        objectives, violation = np.full((len(bits), 3), np.inf), np.zeros(len(bits))
        limits, constraint = self.task.limits, self.task.sphere.admissible(genes)
        stations = iter(self.stations.of(genes[bits]))
        worst = self.task.study.objectives.precision == "max_sigma"
        for row, chosen in enumerate(bits):
            own = [next(stations) for _ in range(int(chosen.sum()))]
            network = [*self.fixed, *own]
            objectives[row, 2] = len(network)
            if len(network) < 2:
                violation[row] = 1e3
                continue
            rays = np.sum([station.sees for station in network], axis=0)
            seen = np.array([station.sees.sum() for station in own], np.int64)
            lacking = np.maximum(limits.min_rays - rays, 0).sum() + np.maximum(1 - seen / self.min_tags, 0).sum()
            lacking += (~constraint[row][chosen]).sum()
            if lacking == 0:
                lacking = loose_images(np.array([station.sees for station in network]))
            if lacking > 0:
                violation[row] = 1.0 + lacking
                continue
            variances = variances_of(np.sum([station.normal for station in network], axis=0), WEAK)
            weak = np.isinf(variances[:, 0]).sum()
            objectives[row, 0] = np.sqrt(variances.max()) if worst else variances.mean()
            objectives[row, 1], refused = self.stations.tour(network) if tours else (0.0, 0)
            violation[row] = weak + refused + excess(objectives[row, 1], self.limit)
        return objectives, violation


def _preferred(preference: Floats, objectives: Floats) -> Floats:
    """(B,) the weighted logarithms of f1 and f2."""
    f1, f2 = np.maximum(objectives[:, 0], 1e-300), objectives[:, 1] + 1e-9
    return np.asarray(preference * np.log(f1) + (1.0 - preference) * np.log(f2))
