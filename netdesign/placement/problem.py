"""Camera network design on the viewing sphere as a problem for ``search``: evaluation, neighbours, what is sure."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property

import numba
import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.progress import Progress, silent
from netdesign.model.task import Task
from netdesign.placement.distances import named_ends
from netdesign.placement.encoding import LARGEST_STEP, SMALLEST_STEP, Chromosomes
from netdesign.placement.evaluation import evaluate_networks, joint_tours, workspace_tours
from netdesign.placement.local_search import ADD, MOVE, REMOVE, Tries, improve_networks
from netdesign.placement.network_problem import ADDITIONS, MOVES, REMOVALS, TELEPORTS, NetworkProblem
from netdesign.placement.preparation import (
    datum_gauge,
    demanded_cover,
    free_slots,
    hypervolume_scale,
    joint_map_of,
    joint_tables,
    lattice_candidates,
    sphere_tables,
    sphere_tours,
)
from netdesign.placement.tables import JointTables, SphereTables
from netdesign.placement.visibility_map import VisibilityMap
from netdesign.search.population import Population

LEAST_CHUNK, CHUNKS = 32, 3  # networks per task of the thread pool, tasks per thread


@dataclass(frozen=True, kw_only=True)
class Problem(NetworkProblem):
    """A study whose stations lie on the viewing sphere: the fast way, compiled from end to end.

    Attributes:
        visibility: what is seen from where.  tables, joint: what the kernels read.
        pinned: (e, 2) viewpoints of the existing stations; the kernels get them in front of the free ones.
        threads: evaluation threads; they do not change any result.
    """

    visibility: VisibilityMap
    tables: SphereTables
    joint: JointTables | None
    pinned: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    threads: int = field(default_factory=lambda: int(numba.get_num_threads()))

    @staticmethod
    def build(task: Task, progress: Progress = silent) -> "Problem":
        """Prepare a study: visibility map, joint map, set cover.

        Raises:
            InputError: [requirements] names a distance between points that do not exist.
            InfeasibleError: some tag can be seen from nowhere, or no station the robot reaches sees enough.
        """
        named_ends(task)
        pinned, _ = task.sphere.placed(task.existing)
        progress("visibility map", 0, 3)
        visibility = VisibilityMap.build(task.scene, task.camera, task.sphere, task.limits)
        progress("joint map", 1, 3)
        joint_map = joint_map_of(task)
        progress("set cover", 2, 3)
        tables = sphere_tables(task, visibility)._replace(fixed=len(pinned))
        slots = free_slots(task)
        stations, there = lattice_candidates(task, visibility, joint_map), visibility.cell_of(pinned)
        sees = visibility.sure_tags(visibility.cell_of(stations))
        cover = demanded_cover(task, stations, sees, visibility.sure_tags(there).sum(axis=0), slots, visibility)
        joint = joint_tables(task, joint_map)
        problem = Problem(
            task=task,
            chromosomes=Chromosomes(sphere=task.sphere, slots=slots),
            visibility=visibility,
            joint_map=joint_map,
            tables=tables,
            joint=joint,
            cover=cover,
            scale=hypervolume_scale(task, slots, lambda networks: sphere_tours(task, joint, networks)),
            gauge=datum_gauge(task),
            pinned=pinned,
        )
        progress("set cover", 3, 3)
        return problem

    def evaluate(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return objectives (P, 3) in SI units and violation (P,); rows are independent, threads share them out."""
        own_bits, own_genes = bits, genes
        bits, genes = self._with_pinned(bits, genes)
        objectives, violation = np.empty((len(bits), 3)), np.empty(len(bits))

        step = self._step(len(bits))

        def part(start: int) -> None:
            rows = slice(start, start + step)
            evaluate_networks(bits[rows], genes[rows], self.tables, objectives[rows], violation[rows])
            if self.joint is None:
                tables = self.tables
                workspace_tours(
                    bits[rows], genes[rows], tables.radius, tables.longest, objectives[rows], violation[rows]
                )

        self._share_out(part, range(0, len(bits), step))
        self._drive(bits, genes, objectives, violation)
        self.propagate_further(own_bits, own_genes, objectives, violation)
        return objectives, violation

    def _drive(self, bits: Bools, genes: Floats, objectives: Floats, violation: Floats) -> None:
        """Put in what the kernels leave out: tours in joints."""
        joint = self.joint
        if joint is not None:
            step = self._step(len(bits))

            def part(start: int) -> None:
                rows = slice(start, start + step)
                joint_tours(bits[rows], genes[rows], joint, objectives[rows], violation[rows])

            self._share_out(part, range(0, len(bits), step))

    def _step(self, count: int) -> int:
        """Networks per call of a kernel: a call takes as long as two networks, a thread needs several to even out."""
        return max(1, count if self.threads == 1 else max(LEAST_CHUNK, -(-count // (CHUNKS * self.threads))))

    def _share_out(self, part: Callable[[int], None], starts: range) -> None:
        """Call ``part`` for every start, on all threads; parts must not share anything they write."""
        if self.threads > 1 and len(starts) > 1:
            list(self._pool.map(part, starts))
        else:
            for start in starts:
                part(start)

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads)

    def limited_scores(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return f1 of the limited propagation and violation, whatever the tour and the criterion's propagation."""
        bits, genes = self._with_pinned(bits, genes)
        objectives, violation = np.empty((len(bits), 3)), np.empty(len(bits))
        evaluate_networks(bits, genes, self.tables, objectives, violation)
        return objectives[:, 0], violation

    def candidates(self) -> Floats:
        """Return viewpoints (c, 2) all over the admissible set, within reach, that see enough for an image."""
        return lattice_candidates(self.task, self.visibility, self.joint_map)

    def sees(self, viewpoints: Floats) -> Bools:
        """Return (k, g) the tags that are seen from the whole cell of each viewpoint (k, 2)."""
        return self.visibility.sure_tags(self.visibility.cell_of(viewpoints))

    def reachable(self, viewpoints: Floats) -> Bools:
        """Return (k,) whether the arm can take viewpoints (k, 2); all of them when motion is in the workspace."""
        if self.joint_map is None:
            return np.ones(len(viewpoints), np.bool_)
        return self.joint_map.reachable(viewpoints)

    def without_tour_limit(self) -> "Problem":
        """Return the problem without requirements.max_tour; itself when there is none."""
        if not np.isfinite(self.longest):
            return self
        joint = None if self.joint is None else self.joint._replace(longest=np.inf)
        return replace(self, tables=self.tables._replace(longest=np.inf), joint=joint)

    @property
    def longest(self) -> float:
        """The longest admissible tour, inf when there is no limit."""
        return float(self.tables.longest if self.joint is None else self.joint.longest)

    @property
    def existing_sees(self) -> Bools:
        """(e, g) the tags that the existing stations see."""
        return self.sees(self.pinned)

    def _with_pinned(self, bits: Bools, genes: Floats) -> tuple[Bools, Floats]:
        """Chromosomes of whole networks: the existing stations first."""
        if len(self.pinned):
            count = (len(bits), len(self.pinned))
            bits = np.concatenate([np.ones(count, np.bool_), bits], axis=1)
            genes = np.concatenate([np.broadcast_to(self.pinned, (*count, 2)), genes], axis=1)
        return np.ascontiguousarray(bits), np.ascontiguousarray(genes)

    def improve(self, rng: np.random.Generator, members: Population, preference: Floats) -> Population:
        """Return evaluated neighbours of feasible members, found by a local search from each of them."""
        fixed = len(self.pinned)
        slots, count, width = fixed + self.chromosomes.slots, len(members), MOVES + REMOVALS + ADDITIONS
        order = np.argsort(~members.bits, axis=1, kind="stable")
        viewpoints = np.take_along_axis(members.genes, order[..., None], axis=1)
        viewpoints = np.concatenate([np.broadcast_to(self.pinned, (count, fixed, 2)), viewpoints], axis=1)
        kind = np.repeat([MOVE, REMOVE, ADD], [MOVES, REMOVALS, ADDITIONS])
        target = self.chromosomes.uniform(rng, (count, width))
        target[(rng.random((count, width)) >= TELEPORTS) & (kind == MOVE)] = np.nan
        bearing = rng.uniform(-np.pi, np.pi, (count, width))
        length = np.exp(rng.uniform(np.log(SMALLEST_STEP), np.log(LARGEST_STEP), (count, width)))
        tries = Tries(
            kind=np.tile(kind, (count, 1)),
            camera=rng.integers(0, 1 << 30, (count, width)),
            viewpoint=target,
            step=np.stack([bearing, length], axis=-1),
            preference=preference,
        )
        sizes = fixed + members.bits.sum(axis=1)
        genes, used = np.zeros((count, width, slots, 2)), np.zeros((count, width), np.int64)
        objectives, violation = np.zeros((count, width, 2)), np.zeros((count, width))

        step = count if self.threads == 1 else 1  # a member takes long enough for a call of its own

        def part(start: int) -> None:
            rows = slice(start, start + step)
            own = Tries(*(draw[rows] for draw in tries))  # type: ignore[arg-type]
            improve_networks(
                viewpoints[rows], sizes[rows], own, self.tables,
                genes[rows], used[rows], objectives[rows], violation[rows],
            )  # fmt: skip

        self._share_out(part, range(0, count, step))
        tried = used.ravel() > 0
        sizes = used.ravel()[tried]
        bits, genes = np.arange(slots) < sizes[:, None], genes.reshape(-1, slots, 2)[tried]
        full = np.column_stack([objectives.reshape(-1, 2)[tried], sizes])
        violation = violation.ravel()[tried]
        self._drive(bits, genes, full, violation)
        bits, genes = bits[:, fixed:], genes[:, fixed:]
        self.propagate_further(bits, genes, full, violation)
        return Population(bits=bits, genes=genes, objectives=full, violation=violation)
