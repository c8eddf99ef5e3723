"""Camera network design as a problem for ``search``: encoding, evaluation, seeds, neighbours, scales."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numba
import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.frames import sphere_directions
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_tour import law_of
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.limited_error import blocked
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_trace import total_trace
from netdesign.placement.coverage import coverage
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.evaluation import (
    MAX_SIGMA,
    MEAN_VARIANCE,
    JointTables,
    SphereTables,
    evaluate_networks,
    motion_objective,
)
from netdesign.placement.set_cover import CANDIDATES, Cover, lattice, smallest_cover
from netdesign.placement.visibility_map import VisibilityMap
from netdesign.search.population import Population, evaluated

NOISE_STEP = np.radians(2.0)  # cells of the table of sigmas: they change slowly with the viewpoint
CHUNK = 32  # networks per task of the thread pool


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One study, ready to be searched.

    Attributes:
        chromosomes: the encoding and its operators.  visibility: what is seen from where.
        joint_map: joints for every viewpoint, None when motion is measured in the workspace.
        tables, joint: what the kernels read.  cover: the smallest set cover found.
        gauge: (3m, 7) of ``datum.inner_basis`` when the criterion is the total mean variance, else None.
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
            InfeasibleError: some tag can be seen from nowhere, or no station the robot reaches sees enough.
        """
        progress("visibility map", 0, 3)
        visibility = VisibilityMap.build(task.scene, task.camera, task.sphere, task.limits)
        progress("joint map", 1, 3)
        moving = task.study.motion != "workspace" and task.cell is not None
        joint_map = JointMap.build(task.cell, task.sphere, task.scene.part) if moving and task.cell else None
        progress("set cover", 2, 3)
        tables = _sphere_tables(task, visibility)
        cover = _cover(task, visibility, joint_map, tables)
        slots = min(task.sphere.max_images, task.study.requirements.max_images or task.sphere.max_images)
        joint = None
        if joint_map is not None and task.cell is not None:
            timed = task.study.motion == "time"
            joint = JointTables(joint_map.arrays, law_of(joint_map.arm), timed, task.cell.dwell if timed else 0.0)
        problem = Problem(
            task=task,
            chromosomes=Chromosomes(sphere=task.sphere, slots=slots),
            visibility=visibility,
            joint_map=joint_map,
            tables=tables,
            joint=joint,
            cover=cover,
            scale=_scale(task, tables, joint, slots),
            gauge=_gauge(task),
        )
        progress("set cover", 3, 3)
        return problem

    def evaluate(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return objectives (P, 3) in SI units and violation (P,); rows are independent, threads share them out."""
        bits, genes = np.ascontiguousarray(bits), np.ascontiguousarray(genes)
        objectives, violation = np.empty((len(bits), 3)), np.empty(len(bits))

        def part(start: int) -> None:
            rows = slice(start, start + CHUNK)
            evaluate_networks(bits[rows], genes[rows], self.tables, self.joint, objectives[rows], violation[rows])

        starts = range(0, len(bits), CHUNK)
        if self.threads > 1 and len(starts) > 1:
            list(self._pool.map(part, starts))
        else:
            for start in starts:
                part(start)
        if self.gauge is not None:
            self._propagate_totally(bits, genes, objectives, violation)
        return objectives, violation

    def _propagate_totally(self, bits: Bools, genes: Floats, objectives: Floats, violation: Floats) -> None:
        """Replace f1 of the feasible rows by total error propagation; what it cannot determine becomes infeasible."""
        task = self.task
        points, intrinsics = task.scene.targets.points, task.camera.intrinsics
        for row in np.flatnonzero(violation <= 0).tolist():
            viewpoints = genes[row][bits[row]]
            poses = task.sphere.cameras(viewpoints)
            visible = np.repeat(self.visibility.sure_tags(self.visibility.cell_of(viewpoints)), CORNERS_PER_TAG, axis=1)
            sigma = np.array([[task.camera.sigma_px]])
            if task.camera.corner_noise is not None:
                sigma = sighting_sigma(task.camera, poses, task.scene.targets)
            trace = total_trace(poses, points, intrinsics, visible, sigma, self.gauge)
            objectives[row, 0] = trace / (3 * len(points))
            violation[row] = 0.0 if np.isfinite(trace) else 0.5

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads)

    def random(self, rng: np.random.Generator, count: int) -> tuple[Bools, Floats]:
        """Return random chromosomes."""
        return self.chromosomes.random(rng, count)

    def seeds(self) -> tuple[Bools, Floats]:
        """Return the smallest cover, and larger networks that contain it: deterministic."""
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
        """Return evaluated neighbours of the members: one camera nudged, moved, added or taken away."""
        neighbours = [self._neighbours(rng, members.bits[row], members.genes[row]) for row in range(len(members))]
        bits, genes = (np.concatenate(parts) for parts in zip(*neighbours, strict=True))
        return evaluated(self.evaluate, bits, genes)

    def _neighbours(
        self, rng: np.random.Generator, bits: Bools, genes: Floats, moves: int = 40
    ) -> tuple[Bools, Floats]:
        """Return ``moves`` networks with one camera moved, every one with a camera less, and four with one more."""
        active, idle = np.flatnonzero(bits), np.flatnonzero(~bits)
        size, extra = len(active), 4 if len(idle) else 0
        fewer = size if size > 2 else 0
        all_bits = np.tile(bits, (moves + fewer + extra, 1))
        all_genes = np.tile(genes, (len(all_bits), 1, 1))
        rows, which = np.arange(moves), active[rng.integers(0, size, moves)]
        far = rng.random(moves) < 0.08
        all_genes[rows, which] = np.where(
            far[:, None], self.chromosomes.uniform(rng, (moves,)), self.chromosomes.nudged(rng, all_genes[rows, which])
        )
        if fewer:
            all_bits[moves + np.arange(fewer), active] = False
        if extra:
            all_bits[moves + fewer :, idle[0]] = True
            all_genes[moves + fewer :, idle[0]] = self.chromosomes.uniform(rng, (extra,))
        return all_bits, all_genes

    def normalise(self, objectives: Floats) -> Floats:
        """Return objectives (P, 3) with 0 at the ideal and 1 at the reference: log f1, f2, f3."""
        values = np.stack([np.log(np.maximum(objectives[:, 0], 1e-300)), objectives[:, 1], objectives[:, 2]], axis=1)
        return np.asarray((values - self.scale[0]) / (self.scale[1] - self.scale[0]))


def _gauge(task: Task) -> Floats | None:
    """The points' datum defect when f1 is the total mean variance; the worst point is searched with the limited one."""
    objectives = task.study.objectives
    if objectives.propagation != "total" or objectives.precision != "mean_variance":
        return None
    return inner_basis(task.scene.targets.points)


def _sphere_tables(task: Task, visibility: VisibilityMap) -> SphereTables:
    """Arrays of the kernels; sigma is constant, or tabulated over coarse cells when the camera has a detector model."""
    camera, sphere, limits, targets = task.camera, task.sphere, task.limits, task.scene.targets
    points = targets.points
    tags = len(targets.ids)
    weight, weight_grid = np.ones((1, tags)), visibility.grid
    if camera.corner_noise is not None:
        columns, rows = (
            max(1, int(np.ceil(count / inverse / NOISE_STEP)))
            for count, inverse in ((visibility.grid[2], visibility.grid[1]), (visibility.grid[5], visibility.grid[4]))
        )
        width, height = visibility.grid[2] / visibility.grid[1], visibility.grid[5] / visibility.grid[4]
        weight_grid = np.array(
            [visibility.grid[0], columns / width, columns, visibility.grid[3], rows / height, rows], dtype=np.float64
        )
        alpha = weight_grid[0] + (np.arange(columns) + 0.5) / weight_grid[1]
        beta = weight_grid[3] + (np.arange(rows) + 0.5) / weight_grid[4]
        cells = np.stack([np.tile(alpha, rows), np.repeat(beta, columns)], axis=1)
        sigma = sighting_sigma(camera, sphere.cameras(cells), targets).reshape(len(cells), tags, CORNERS_PER_TAG)
        weight = (camera.sigma_px**2 / sigma**2).mean(axis=2)
    longest = task.study.requirements.max_tour
    return SphereTables(
        points=blocked((points - sphere.centre).T),
        point_count=len(points),
        tags=tags,
        radius=sphere.radius,
        grid=visibility.grid,
        sure=visibility.sure,
        weight=np.ascontiguousarray(weight),
        weight_grid=weight_grid,
        variance=float(camera.sigma_px**2 / (camera.focal_px**2).mean()),
        min_rays=limits.min_rays,
        min_tags=max(1, -(-limits.min_points_per_image // CORNERS_PER_TAG)),
        criterion=MAX_SIGMA if task.study.objectives.precision == "max_sigma" else MEAN_VARIANCE,
        longest=np.inf if longest is None else longest * (1e-3 if task.study.motion == "workspace" else 1.0),
    )


def _candidates(
    task: Task, visibility: VisibilityMap, joint_map: JointMap | None, tables: SphereTables
) -> tuple[Floats, Ints]:
    """Lattice viewpoints inside the range that the robot reaches and that see enough tags, and their cells."""
    (low_a, high_a), (low_b, high_b) = task.sphere.azimuth, task.sphere.elevation
    share = (high_a - low_a) * (np.sin(high_b) - np.sin(low_b)) / (4 * np.pi)
    viewpoints = lattice(int(np.ceil(CANDIDATES / share)))
    viewpoints[:, 0] = low_a + np.remainder(viewpoints[:, 0] - low_a, 2 * np.pi)
    inside = (viewpoints[:, 0] <= high_a) & (viewpoints[:, 1] >= low_b) & (viewpoints[:, 1] <= high_b)
    viewpoints = viewpoints[inside]
    if joint_map is not None:
        viewpoints = viewpoints[joint_map.reachable(viewpoints)]
    cells = visibility.cell_of(viewpoints)
    enough = visibility.sure_tags(cells).sum(axis=1) >= tables.min_tags
    return viewpoints[enough], cells[enough]


def _cover(task: Task, visibility: VisibilityMap, joint_map: JointMap | None, tables: SphereTables) -> Cover:
    """Solve the set cover.

    Raises:
        InfeasibleError: no candidate sees enough, or a tag is seen from nowhere, or too many images are needed.
    """
    viewpoints, cells = _candidates(task, visibility, joint_map, tables)
    if len(viewpoints) == 0:
        raise InfeasibleError(
            f"no viewpoint {'within reach of the robot ' if joint_map else ''}sees {tables.min_tags} tags"
            f" (min_points_per_image = {task.limits.min_points_per_image}); `netdesign check` counts the reasons"
        )
    cover = smallest_cover(viewpoints, visibility.sure_tags(cells), tables.min_rays, task.sphere.max_images)
    if len(cover.viewpoints) == 0 or len(cover.viewpoints) > task.sphere.max_images:
        coverage(task, visibility).demand_feasible()
    return cover


def _scale(task: Task, tables: SphereTables, joint: JointTables | None, slots: int) -> Floats:
    """Ideal and reference point of the hypervolume.

    log f1 from the closed-form bound of ``slots`` images to 100 times it; f2 from 0 to the longest tour over ``slots``
    random stations in 20 samples; f3 from 1 to slots + 1.
    """
    bound = 1.5 * tables.variance * (task.sphere.radius**2) / slots
    samples = Chromosomes(sphere=task.sphere, slots=slots).uniform(np.random.default_rng(0), (20, slots))
    longest = max(
        motion_objective(viewpoints, sphere_directions(viewpoints), tables, joint)[0] for viewpoints in samples
    )
    if tables.criterion == MAX_SIGMA:
        ideal, reference = 0.5 * np.log(bound), 0.5 * np.log(100 * bound)
    else:
        ideal, reference = np.log(bound), np.log(100 * bound)
    return np.array([[ideal, 0.0, 1.0], [reference, max(longest, 1e-9), slots + 1.0]])
