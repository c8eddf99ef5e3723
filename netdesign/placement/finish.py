"""From the archive of a search to the reported front: every number exact.

The search works on proved visibility bits, undistorted optics and heuristic tours; here each kept network gets exact
rays, the covariance with distortion, the exact tour, total error propagation and its bound. What turns out inadmissible
or dominated is dropped and counted.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Literal

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.progress import Progress, silent
from netdesign.model.results import Design, DesignedNetwork, PointPrecision, SearchHistory, Tour
from netdesign.model.task import Task
from netdesign.motion.plan import plan_on
from netdesign.motion.tour import open_path
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_error import total_covariance
from netdesign.photogrammetry.total_trace import block_trace
from netdesign.photogrammetry.visibility import Sight
from netdesign.placement.infeasible import why_infeasible
from netdesign.placement.network_problem import NetworkProblem
from netdesign.placement.tolerance import cheapest_admissible
from netdesign.search.archive import non_dominated
from netdesign.search.state import State

UNDETERMINED = "not determined in total error propagation"
_TOO_LOOSE = (
    "; their images hang together by too few common points: viewpoints.max_images or visibility.max_incidence_deg"
    " may have to grow"
)
LIMITED_DATUM = "fixed: the poses are error-free"
COARSE = 25.0  # times the smallest f1 of a front: five times its sigma
MEANINGLESS = 0.1  # share of the object's radius beyond which a sigma is no sigma
SPARE = 1.5  # networks computed exactly per network kept: some fall to exact rays or to domination


def finish(problem: NetworkProblem, state: State, progress: Progress = silent) -> Design:
    """Return the front of a finished (or interrupted) search.

    At most ``search.max_networks`` networks, spread over all sizes; f1 falls and f2 rises strictly along each size, and
    no network dominates another.

    Raises:
        InfeasibleError: nothing feasible was found; the message names the constraint that binds.
    """
    task = problem.task
    members = state.archive.members
    if len(members) == 0:
        raise InfeasibleError(why_infeasible(problem, state))
    rows = non_dominated(members.objectives)
    most = task.study.search.max_networks
    rows = rows[spread(members.objectives[rows], int(np.ceil(SPARE * most)))]
    exact = Exact(problem)
    networks: list[DesignedNetwork] = []
    dropped: Counter[str] = Counter()
    for number, row in enumerate(rows.tolist()):
        progress("exact networks", number, len(rows))
        found = exact.network(members.genes[row][members.bits[row]])
        if isinstance(found, str):
            dropped[found] += 1
        else:
            networks.append(found)
    if not networks and dropped[UNDETERMINED]:
        networks = _started_with(problem, exact)
    progress("exact networks", len(rows), len(rows))
    answer = cheapest_admissible(problem, members, exact.network, progress)
    best = None if answer is None else answer.network
    if best is not None:  # what dominates it without keeping the requirements is no answer
        networks = [network for network in networks if not _dominates(network, best)] + [best]
    if not networks:
        help_ = _TOO_LOOSE if dropped[UNDETERMINED] else ""
        raise InfeasibleError(f"no network of the search survived the exact check: {_counts(dropped)}{help_}")
    objectives = np.array([[network.f1, network.f2, network.f3] for network in networks])
    kept = non_dominated(objectives)
    dropped["dominated once computed exactly"] += len(networks) - len(kept)
    place = None if best is None else len(networks) - 1
    rest = kept[kept != place]
    kept = rest[spread(objectives[rest], most - (place is not None))]
    kept = kept if place is None else np.append(kept, place)
    kept = kept[np.lexsort((objectives[kept, 1], objectives[kept, 0], objectives[kept, 2]))]
    bounds = problem.bounds(sorted({networks[row].f3 for row in kept}), progress)
    return Design(
        networks=tuple(_bounded(networks[row], bounds) for row in kept.tolist()),
        history=SearchHistory(evaluations=state.evaluations, hypervolume=state.hypervolume),
        bounds=bounds,
        notes=tuple(_notes(problem, [networks[row] for row in kept.tolist()], dropped)),
        answer=None if answer is None else (None if place is None else int(np.flatnonzero(kept == place)[0])),
        answer_reason=None if answer is None else answer.reason,
    )


def _started_with(problem: NetworkProblem, exact: "Exact") -> list[DesignedNetwork]:
    """Return the networks that the search starts from, exact: where images hardly hang together, some of them do.

    The search counts common tags only, and leaves out what ties images better than that for the sake of f1.
    """
    bits, genes = problem.seeds()
    found = [exact.network(viewpoints[chosen]) for chosen, viewpoints in zip(bits, genes, strict=True)]
    return [network for network in found if not isinstance(network, str)]


class Exact:
    """Scene, robot and sightings prepared once for many networks."""

    def __init__(self, problem: NetworkProblem) -> None:
        self.problem = problem
        task = problem.task
        self.sight = Sight(task.scene, task.camera, task.limits)

    def network(self, viewpoints: Floats) -> DesignedNetwork | str:
        """Return the network of viewpoints (n, 2) with every number exact, or in a few words why it is inadmissible."""
        task, limits = self.problem.task, self.problem.task.limits
        planned = self._planned(viewpoints)
        if isinstance(planned, str):
            return planned
        world_from_cam, tour, warnings = planned
        viewpoints, radius = task.sphere.placed(world_from_cam)
        if tour.length > self.problem.longest:
            return "longer tour than requirements.max_tour"
        visible = self.sight.look(world_from_cam).visible
        rays = visible.sum(axis=0)
        if (rays < limits.min_rays).any():
            return f"a point with fewer than {limits.min_rays} exact rays"
        given = np.linalg.norm(world_from_cam[:, None, :3, 3] - task.existing[:, :3, 3], axis=2) < 1e-6
        if ((visible.sum(axis=1) < limits.min_points_per_image) & ~given.any(axis=1)).any():
            return f"an image with fewer than {limits.min_points_per_image} points"
        limited, total, complaints = predicted(task, world_from_cam, visible, rays)
        if not np.isfinite(limited.covariance).all():
            return "a point whose rays are parallel"
        # Limited propagation is blind to images that hang together by too little: such a network has no accuracy.
        if total is None or _means_nothing(total, task.scene.targets.points):
            return UNDETERMINED
        precision = total if task.study.objectives.propagation == "total" else limited
        f1 = precision.mean_variance
        if task.study.objectives.precision == "max_sigma":
            f1 = float(precision.sigma.max())
        elif task.study.objectives.propagation == "block":
            sigma = sighting_sigma(task.camera, world_from_cam, task.scene.targets)
            points, intrinsics = task.scene.targets.points, task.camera.intrinsics
            f1 = block_trace(world_from_cam, points, intrinsics, visible, sigma) / (3 * len(points))
        return DesignedNetwork(
            viewpoints=viewpoints,
            radius=radius,
            world_from_cam=world_from_cam,
            f1=f1,
            f2=tour.length,
            f3=len(viewpoints),
            tour=tour,
            precision=precision,
            total=total,
            bound_ratio=None,
            warnings=(*warnings, *complaints),
            flagged=bool(complaints),
        )

    def _planned(self, viewpoints: Floats) -> tuple[Floats, Tour, Sequence[str]] | str:
        """Poses in visiting order, the tour, warnings; or why the robot cannot."""
        task = self.problem.task
        poses = self.problem.poses(viewpoints)
        if self.problem.joint_map is not None:
            motion: Literal["joint", "time"] = "time" if task.study.motion == "time" else "joint"
            plan = plan_on(self.problem.joint_map, viewpoints, motion, task.study.seed, task.existing)
            if plan.tour is None:
                return f"a station the robot cannot take ({', '.join(sorted({reason for _, reason in plan.refused}))})"
            return plan.world_from_cam, plan.tour, plan.warnings
        positions = poses[:, :3, 3]
        order, _ = open_path(np.linalg.norm(positions[:, None] - positions[None], axis=2), task.study.seed)
        length = float(np.linalg.norm(np.diff(positions[order], axis=0), axis=1).sum())
        tour = Tour(order=np.arange(len(order)), length=length, space="workspace")
        return poses[order], tour, ()


def _means_nothing(total: PointPrecision, points: Floats) -> bool:
    """Tell whether a predicted sigma is so large a share of the object (m, 3) that linear propagation says nothing.

    Such a network hangs together by rounding errors or by rays that all but coincide; its adjustment need not converge.
    """
    extent = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    return bool(np.sqrt(total.mean_variance) > MEANINGLESS * extent)


def predicted(
    task: Task, world_from_cam: Floats, visible: Bools, rays: Ints
) -> tuple[PointPrecision, PointPrecision | None, tuple[str, ...]]:
    """Return (limited, total or None when not determined, what is weak) of poses (n, 4, 4) and sightings (n, m)."""
    points, intrinsics = task.scene.targets.points, task.camera.intrinsics
    sigma = sighting_sigma(task.camera, world_from_cam, task.scene.targets)
    covariance = limited_covariance(world_from_cam, points, intrinsics, visible, sigma)
    limited = PointPrecision(covariance=covariance, rays=rays, propagation="limited", datum=LIMITED_DATUM)
    stations = [str(number + 1) for number in range(len(world_from_cam))]  # in visiting order, as the report counts
    names = task.scene.targets.point_ids
    total = total_covariance(
        world_from_cam, points, intrinsics, visible, sigma, image_names=stations, point_names=names
    )
    return limited, total.precision if total.determined else None, total.diagnosis


def spread(objectives: Floats, most: int) -> Ints:
    """Return at most ``most`` rows of a front (N, 3), ascending, that stand for all of it.

    First the most precise network of every size (of sizes evenly chosen when there are too many), then the one with the
    shortest tour, then always the network farthest from the chosen ones in log f1, f2 and f3, scaled to their ranges.
    Networks of more than COARSE times the smallest f1 buy a short tour with next to no precision: they come last.
    """
    if len(objectives) <= most or most <= 0:
        return np.arange(min(len(objectives), max(most, 0)))
    f1, f2, f3 = np.maximum(objectives.T, 1e-300)
    sizes = np.unique(f3)
    sizes = sizes[np.unique(np.round(np.linspace(0, len(sizes) - 1, min(most, len(sizes)))).astype(np.int64))]
    chosen = [int(np.argmin(np.where(f3 == size, f1, np.inf))) for size in sizes]
    good = f1 <= COARSE * f1.min()
    shortest = int(np.argmin(np.where(good, f2, np.inf)))
    if len(chosen) < most and shortest not in chosen:
        chosen.append(shortest)
    places = np.column_stack([np.log(f1), f2, f3])
    places = (places - places[good].min(axis=0)) / np.maximum(np.ptp(places[good], axis=0), 1e-300)
    distance = np.linalg.norm(places[:, None] - places[None, chosen], axis=2).min(axis=1)
    while len(chosen) < most:
        distance[chosen] = -1.0
        open_to_choice = good & (distance >= 0.0)
        chosen.append(int(np.argmax(np.where(open_to_choice, distance, -1.0) if open_to_choice.any() else distance)))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return np.sort(np.array(chosen, dtype=np.int64))


def _dominates(one: DesignedNetwork, other: DesignedNetwork) -> bool:
    return one.f1 <= other.f1 and one.f2 <= other.f2 and one.f3 <= other.f3


def _bounded(network: DesignedNetwork, bounds: dict[int, float]) -> DesignedNetwork:
    bound = bounds.get(network.f3)
    if bound is None:
        return network
    content = {name: getattr(network, name) for name in network.__dataclass_fields__}
    return DesignedNetwork(**{**content, "bound_ratio": network.f1 / bound})


def _counts(dropped: Counter[str]) -> str:
    return ", ".join(f"{count} with {reason}" for reason, count in sorted(dropped.items()) if count)


def _notes(problem: NetworkProblem, networks: Sequence[DesignedNetwork], dropped: Counter[str]) -> list[str]:
    notes = []
    cover = problem.cover
    size, fewest = len(cover.viewpoints), min(network.f3 for network in networks)
    existing = len(problem.task.existing)
    if existing:
        notes.append(f"every network contains the {existing} existing stations")
    if size and not existing:
        optimal = (
            "no smaller choice of them does" if cover.least == size else f"of them at least {cover.least} are needed"
        )
        found = f"; the front goes down to {fewest}" if fewest < size else ""
        notes.append(
            f"set cover: {size} of {cover.candidates} candidate stations see every point"
            f" {problem.task.limits.min_rays} times, {optimal}; stations between them may need fewer{found}"
        )
    if sum(dropped.values()):
        notes.append("left out of the front after the exact check: " + _counts(dropped))
    return notes
