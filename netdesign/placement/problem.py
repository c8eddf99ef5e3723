"""Camera network design as a problem for ``search``: encoding, evaluation, seeds, neighbours, scales."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numba
import numpy as np

from netdesign.errors import InputError
from netdesign.model.arrays import Bools, Floats
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_trace import block_trace, total_trace
from netdesign.placement.distances import named_ends
from netdesign.placement.encoding import LARGEST_STEP, SMALLEST_STEP, Chromosomes
from netdesign.placement.evaluation import (
    JointTables,
    SphereTables,
    evaluate_networks,
    joint_tours,
)
from netdesign.placement.local_search import ADD, MOVE, REMOVE, Tries, improve_networks
from netdesign.placement.optimal_design import information_of, rounded_networks
from netdesign.placement.preparation import (
    candidates,
    datum_gauge,
    demanded_cover,
    hypervolume_scale,
    joint_tables,
    sphere_tables,
)
from netdesign.placement.set_cover import Cover
from netdesign.placement.visibility_map import VisibilityMap
from netdesign.search.population import Population

CHUNK = 32  # networks per task of the thread pool
MOVES, REMOVALS, ADDITIONS = 40, 8, 4  # networks tried around one member in the local search
TELEPORTS = 0.08  # share of the moves that go anywhere


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One study, ready to be searched.

    Attributes:
        chromosomes: the encoding and its operators.  visibility: what is seen from where.
        joint_map: joints for every viewpoint, None when motion is measured in the workspace.
        tables, joint: what the kernels read.  cover: the smallest set cover found.
        gauge: (3m, 7) of ``datum.inner_basis`` when the criterion is the total or block mean variance, else None.
        scale: (2, 3) ideal and reference point of the normalised objectives (log f1, f2, f3).
        threads: evaluation threads; they do not change any result.
    """

    task: Task
    chromosomes: Chromosomes
    visibility: VisibilityMap
    joint_map: JointMap | None
    tables: SphereTables
    joint: JointTables | None
    cover: Cover
    scale: Floats
    gauge: Floats | None = None
    threads: int = field(default_factory=lambda: int(numba.get_num_threads()))

    @staticmethod
    def build(task: Task, progress: Progress = silent) -> "Problem":
        """Prepare a study: visibility map, joint map, set cover.

        Raises:
            InputError: [requirements] names a distance between points that do not exist.
            InfeasibleError: some tag can be seen from nowhere, or no station the robot reaches sees enough.
        """
        named_ends(task)
        if len(task.existing):
            raise InputError("viewpoints.existing: only `netdesign repair` takes existing stations, not yet a search")
        progress("visibility map", 0, 3)
        visibility = VisibilityMap.build(task.scene, task.camera, task.sphere, task.limits)
        progress("joint map", 1, 3)
        moving = task.study.motion != "workspace" and task.cell is not None
        joint_map = JointMap.build(task.cell, task.sphere, task.scene.part) if moving and task.cell else None
        progress("set cover", 2, 3)
        tables = sphere_tables(task, visibility)
        cover = demanded_cover(task, visibility, joint_map, tables)
        slots = min(task.sphere.max_images, task.study.requirements.max_images or task.sphere.max_images)
        joint = joint_tables(task, joint_map)
        problem = Problem(
            task=task,
            chromosomes=Chromosomes(sphere=task.sphere, slots=slots),
            visibility=visibility,
            joint_map=joint_map,
            tables=tables,
            joint=joint,
            cover=cover,
            scale=hypervolume_scale(task, tables, joint, slots),
            gauge=datum_gauge(task),
        )
        progress("set cover", 3, 3)
        return problem

    def evaluate(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return objectives (P, 3) in SI units and violation (P,); rows are independent, threads share them out."""
        bits, genes = np.ascontiguousarray(bits), np.ascontiguousarray(genes)
        objectives, violation = np.empty((len(bits), 3)), np.empty(len(bits))

        def part(start: int) -> None:
            rows = slice(start, start + CHUNK)
            evaluate_networks(bits[rows], genes[rows], self.tables, objectives[rows], violation[rows])

        self._share_out(part, range(0, len(bits), CHUNK))
        self._complete(bits, genes, objectives, violation)
        return objectives, violation

    def _complete(self, bits: Bools, genes: Floats, objectives: Floats, violation: Floats) -> None:
        """Put in what the kernels leave out: tours in joints, total propagation."""
        joint = self.joint
        if joint is not None:

            def part(start: int) -> None:
                rows = slice(start, start + CHUNK)
                joint_tours(bits[rows], genes[rows], joint, objectives[rows], violation[rows])

            self._share_out(part, range(0, len(bits), CHUNK))
        if self.gauge is not None:
            self._propagate_further(bits, genes, objectives, violation)

    def _propagate_further(self, bits: Bools, genes: Floats, objectives: Floats, violation: Floats) -> None:
        """Replace f1 of the feasible rows by total or block propagation; what is not determined becomes infeasible."""
        task = self.task
        points, intrinsics = task.scene.targets.points, task.camera.intrinsics
        for row in np.flatnonzero(violation <= 0).tolist():
            viewpoints = genes[row][bits[row]]
            poses = task.sphere.cameras(viewpoints)
            visible = np.repeat(self.visibility.sure_tags(self.visibility.cell_of(viewpoints)), CORNERS_PER_TAG, axis=1)
            sigma = np.array([[task.camera.sigma_px]])
            if task.camera.corner_noise is not None:
                sigma = sighting_sigma(task.camera, poses, task.scene.targets)
            if task.study.objectives.propagation == "block":
                trace = block_trace(poses, points, intrinsics, visible, sigma)
            else:
                trace = total_trace(poses, points, intrinsics, visible, sigma, self.gauge)
            objectives[row, 0] = trace / (3 * len(points))
            violation[row] = 0.0 if np.isfinite(trace) else 0.5

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

    def random(self, rng: np.random.Generator, count: int) -> tuple[Bools, Floats]:
        """Return random chromosomes."""
        return self.chromosomes.random(rng, count)

    def seeds(self) -> tuple[Bools, Floats]:
        """Return the rounded optimal design of every size, the smallest cover, and larger networks that contain it."""
        slots = self.chromosomes.slots
        designed = self._designed()
        genes = np.zeros((len(designed), slots, 2))
        for row, viewpoints in enumerate(designed):
            genes[row, : len(viewpoints)] = self.chromosomes.folded(viewpoints)
        bits = np.arange(slots) < np.array([len(viewpoints) for viewpoints in designed], np.int64)[:, None]
        cover_bits, cover_genes = self._cover_seeds()
        return np.concatenate([bits, cover_bits]), np.concatenate([genes, cover_genes])

    def _designed(self) -> list[Floats]:
        """Networks near the best f1 of every size from that of the cover on, of stations of the set cover's lattice."""
        viewpoints, cells = candidates(self.task, self.visibility, self.joint_map, self.tables)
        visible = np.repeat(self.visibility.sure_tags(cells), CORNERS_PER_TAG, axis=1)
        flat = information_of(self.task, self.task.sphere.cameras(viewpoints), visible)
        tables = self.tables._replace(in_joints=True)  # whatever the tour

        def score(bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
            objectives, violation = np.empty((len(bits), 3)), np.empty(len(bits))
            evaluate_networks(bits, np.ascontiguousarray(genes), tables, objectives, violation)
            return objectives[:, 0], violation

        first = max(len(self.cover.viewpoints), 2)
        return rounded_networks(viewpoints, flat, range(first, self.chromosomes.slots + 1), score)

    def _cover_seeds(self) -> tuple[Bools, Floats]:
        """The smallest cover, and larger networks that contain it: deterministic."""
        size, slots = len(self.cover.viewpoints), self.chromosomes.slots
        if size == 0 or size > slots:
            return np.zeros((0, slots), np.bool_), np.zeros((0, slots, 2))
        rng = np.random.default_rng(0)
        count = 4 * (slots - size + 1)
        genes = self.chromosomes.uniform(rng, (count, slots))
        genes[:, :size] = self.chromosomes.folded(self.cover.viewpoints)
        bits = np.arange(slots) < (size + np.arange(count) % (slots - size + 1))[:, None]
        return bits, genes

    def vary_plain(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return children by the source paper's operators."""
        return self.chromosomes.vary_plain(rng, first, second)

    def vary_structured(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return children by cut-and-splice and structural mutation."""
        return self.chromosomes.vary_structured(rng, first, second)

    def improve(self, rng: np.random.Generator, members: Population) -> Population:
        """Return evaluated neighbours of feasible members, found by a local search from each of them."""
        slots, count, width = self.chromosomes.slots, len(members), MOVES + REMOVALS + ADDITIONS
        order = np.argsort(~members.bits, axis=1, kind="stable")
        viewpoints = np.take_along_axis(members.genes, order[..., None], axis=1)
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
            preference=rng.random(count),
        )
        sizes = members.bits.sum(axis=1)
        genes, used = np.zeros((count, width, slots, 2)), np.zeros((count, width), np.int64)
        objectives, violation = np.zeros((count, width, 2)), np.zeros((count, width))

        def part(start: int) -> None:
            rows = slice(start, start + 1)
            own = Tries(*(draw[rows] for draw in tries))  # type: ignore[arg-type]
            improve_networks(
                viewpoints[rows], sizes[rows], own, self.tables,
                genes[rows], used[rows], objectives[rows], violation[rows],
            )  # fmt: skip

        self._share_out(part, range(count))
        tried = used.ravel() > 0
        sizes = used.ravel()[tried]
        bits, genes = np.arange(slots) < sizes[:, None], genes.reshape(-1, slots, 2)[tried]
        full = np.column_stack([objectives.reshape(-1, 2)[tried], sizes])
        violation = violation.ravel()[tried]
        self._complete(bits, genes, full, violation)
        return Population(bits=bits, genes=genes, objectives=full, violation=violation)

    def normalise(self, objectives: Floats) -> Floats:
        """Return objectives (P, 3) with 0 at the ideal and 1 at the reference: log f1, f2, f3."""
        values = np.stack([np.log(np.maximum(objectives[:, 0], 1e-300)), objectives[:, 1], objectives[:, 2]], axis=1)
        return np.asarray((values - self.scale[0]) / (self.scale[1] - self.scale[0]))
