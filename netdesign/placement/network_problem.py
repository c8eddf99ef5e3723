"""What every camera network problem offers to ``search`` and to ``finish``, whatever the stations."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import sphere_directions
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.photogrammetry.connectivity import loose_images
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_trace import block_trace, total_trace
from netdesign.placement.bound import lower_bounds
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.optimal_design import information_of, rounded_networks
from netdesign.placement.set_cover import Cover
from netdesign.placement.ties import PER_TIE, tying_stations
from netdesign.search.population import Population

MOVES, REMOVALS, ADDITIONS = 40, 8, 4  # networks tried around one member in the local search
TELEPORTS = 0.08  # share of the moves that go anywhere
CONNECTORS = 6000  # stations among which images are sought that tie a network together


@dataclass(frozen=True, kw_only=True)
class NetworkProblem(ABC):
    """A study, ready to be searched. Chromosomes hold the free stations; ``task.existing`` belong to every network.

    Attributes:
        chromosomes: the encoding and its operators.  cover: the smallest set cover found.
        gauge: (3m, 7) of ``datum.inner_basis`` when the criterion is the total or block mean variance, else None.
        scale: (2, 3) ideal and reference point of the normalised objectives (log f1, f2, f3).
        joint_map: joints for every viewpoint, None when motion is measured in the workspace.
    """

    task: Task
    chromosomes: Chromosomes
    cover: Cover
    scale: Floats
    gauge: Floats | None = None
    joint_map: JointMap | None = None

    @abstractmethod
    def evaluate(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return objectives (P, 3) in SI units and violation (P,) of chromosomes."""

    @abstractmethod
    def improve(self, rng: np.random.Generator, members: Population, preference: Floats) -> Population:
        """Return evaluated neighbours of feasible members, found by a local search from each of them."""

    @abstractmethod
    def limited_scores(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return f1 of the limited propagation and violation, whatever the tour and the criterion's propagation."""

    @abstractmethod
    def candidates(self) -> Floats:
        """Return viewpoints (c, d) all over the admissible set, within reach, that see enough for an image."""

    @abstractmethod
    def sees(self, viewpoints: Floats) -> Bools:
        """Return (k, g) the tags that are seen from viewpoints (k, d) for certain."""

    @abstractmethod
    def reachable(self, viewpoints: Floats) -> Bools:
        """Return (k,) whether the arm can take viewpoints (k, d); all of them when motion is in the workspace."""

    def bounds(self, sizes: Iterable[int], progress: Progress = silent) -> dict[int, float]:
        """Return proven lower bounds on f1 by number of images; empty where nothing is proved."""
        return lower_bounds(self.task, sizes, progress)

    @abstractmethod
    def without_tour_limit(self) -> Self:
        """Return the problem without requirements.max_tour; itself when there is none."""

    @property
    @abstractmethod
    def longest(self) -> float:
        """The longest admissible tour, inf when there is no limit."""

    @property
    def existing_sees(self) -> Bools:
        """(e, g) the tags that the existing stations see."""
        return np.zeros((0, len(self.task.scene.targets.ids)), np.bool_)

    @property
    def min_tags(self) -> int:
        """Tags that an image must see."""
        return max(1, -(-self.task.limits.min_points_per_image // CORNERS_PER_TAG))

    def poses(self, viewpoints: Floats) -> Floats:
        """Return world_from_cam (e + k, 4, 4) of a network: the existing stations, then viewpoints (k, d)."""
        return np.concatenate([self.task.existing, self.task.sphere.cameras(viewpoints)])

    def visible(self, viewpoints: Floats) -> Bools:
        """Return (e + k, m) which image of a network sees which object point."""
        return np.repeat(np.concatenate([self.existing_sees, self.sees(viewpoints)]), CORNERS_PER_TAG, axis=1)

    def random(self, rng: np.random.Generator, count: int) -> tuple[Bools, Floats]:
        """Return random chromosomes."""
        return self.chromosomes.random(rng, count)

    def vary_plain(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return children by the source paper's operators."""
        return self.chromosomes.vary_plain(rng, first, second)

    def vary_structured(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return children by cut-and-splice and structural mutation."""
        return self.chromosomes.vary_structured(rng, first, second)

    def seeds(self) -> tuple[Bools, Floats]:
        """Return the rounded optimal design of every size, the smallest cover, and larger networks that contain it.

        What falls apart into images without a common tag gets the images that tie it together, while there is room.
        """
        slots = self.chromosomes.slots
        designed = [self._tied(viewpoints) for viewpoints in self._designed()]
        genes = np.zeros((len(designed), slots, self.task.sphere.genes))
        for row, viewpoints in enumerate(designed):
            genes[row, : len(viewpoints)] = self.chromosomes.folded(viewpoints)
        bits = np.arange(slots) < np.array([len(viewpoints) for viewpoints in designed], np.int64)[:, None]
        cover_bits, cover_genes = self._cover_seeds()
        return np.concatenate([bits, cover_bits]), np.concatenate([genes, cover_genes])

    def _designed(self) -> list[Floats]:
        """Networks near the best f1 of every size from that of the cover on, of stations of the set cover's lattice."""
        viewpoints = self.candidates()
        visible = np.repeat(self.sees(viewpoints), CORNERS_PER_TAG, axis=1)
        flat = information_of(self.task, self.task.sphere.cameras(viewpoints), visible)
        # A point that hardly anything sees may be seen between the stations of the lattice only.
        flat = flat.reshape(len(flat), -1, 6)[:, visible.any(axis=0)].reshape(len(flat), -1)
        first = max(len(self.cover.viewpoints), 1 if len(self.task.existing) else 2)
        return rounded_networks(viewpoints, flat, range(first, self.chromosomes.slots + 1), self.limited_scores)

    def _cover_seeds(self) -> tuple[Bools, Floats]:
        """The smallest cover, and larger networks that contain it: deterministic."""
        smallest, slots = self._tied(self.cover.viewpoints), self.chromosomes.slots
        size = len(smallest)
        if size == 0 or size > slots:
            return np.zeros((0, slots), np.bool_), np.zeros((0, slots, self.task.sphere.genes))
        rng = np.random.default_rng(0)
        count = 4 * (slots - size + 1)
        genes = self.chromosomes.uniform(rng, (count, slots))
        genes[:, :size] = self.chromosomes.folded(smallest)
        bits = np.arange(slots) < (size + np.arange(count) % (slots - size + 1))[:, None]
        return bits, genes

    def _tied(self, viewpoints: Floats) -> Floats:
        """Return viewpoints (k, d), with those behind them that tie their images together if these fall apart."""
        sees = np.concatenate([self.existing_sees, self.sees(viewpoints)])
        room = self.chromosomes.slots - len(viewpoints)
        if len(viewpoints) == 0 or room < PER_TIE or not loose_images(sees):
            return viewpoints
        stations, seen = self._connectors
        directions = sphere_directions(stations[:, :2])
        return np.concatenate([viewpoints, stations[tying_stations(sees, directions, seen, room)]])

    @cached_property
    def _connectors(self) -> tuple[Floats, Bools]:
        """Stations (c, d) of a finer lattice than that of the set cover, within reach, and the tags (c, g) they see."""
        stations = self.chromosomes.spread(CONNECTORS)
        stations = stations[self.reachable(stations)]
        sees = self.sees(stations)
        enough = sees.sum(axis=1) >= self.min_tags
        return stations[enough], sees[enough]

    def normalise(self, objectives: Floats) -> Floats:
        """Return objectives (P, 3) with 0 at the ideal and 1 at the reference: log f1, f2, f3."""
        values = np.stack([np.log(np.maximum(objectives[:, 0], 1e-300)), objectives[:, 1], objectives[:, 2]], axis=1)
        return np.asarray((values - self.scale[0]) / (self.scale[1] - self.scale[0]))

    def propagate_further(self, bits: Bools, genes: Floats, objectives: Floats, violation: Floats) -> None:
        """Replace f1 of the feasible rows by total or block propagation; what is not determined becomes infeasible."""
        if self.gauge is None:
            return
        task = self.task
        points, intrinsics = task.scene.targets.points, task.camera.intrinsics
        for row in np.flatnonzero(violation <= 0).tolist():
            viewpoints = genes[row][bits[row]]
            poses, visible = self.poses(viewpoints), self.visible(viewpoints)
            sigma = sighting_array(task, poses)
            if task.study.objectives.propagation == "block":
                trace = block_trace(poses, points, intrinsics, visible, sigma)
            else:
                trace = total_trace(poses, points, intrinsics, visible, sigma, self.gauge)
            objectives[row, 0] = trace / (3 * len(points))
            violation[row] = 0.0 if np.isfinite(trace) else 0.5


def sighting_array(task: Task, poses: Floats) -> Floats:
    """Return the sigma (n, m) px of every sighting, or (1, 1) when it is constant, as the kernels take it."""
    if task.camera.corner_noise is None:
        return np.array([[task.camera.sigma_px]])
    return sighting_sigma(task.camera, poses, task.scene.targets)
