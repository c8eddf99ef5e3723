"""What a search needs before it starts: the kernels' tables, the set cover, the scales of the hypervolume."""

from collections.abc import Callable

import numpy as np

from netdesign.errors import InfeasibleError, InputError
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_tour import law_of
from netdesign.motion.options import exact_options
from netdesign.motion.tour import path_length
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.limited_error import LANES, blocked
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.placement.coverage import coverage
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.evaluation import joint_tours
from netdesign.placement.set_cover import CANDIDATES, Cover, smallest_cover
from netdesign.placement.tables import MAX_SIGMA, MEAN_VARIANCE, JointTables, SphereTables
from netdesign.placement.visibility_map import VisibilityMap

NOISE_STEP = np.radians(2.0)  # cells of the table of sigmas: they change slowly with the viewpoint


def datum_gauge(task: Task) -> Floats | None:
    """The points' datum defect unless f1 is limited; the worst point is searched with limited propagation."""
    objectives = task.study.objectives
    if objectives.propagation == "limited" or objectives.precision != "mean_variance":
        return None
    return inner_basis(task.scene.targets.points)


def sphere_tables(task: Task, visibility: VisibilityMap) -> SphereTables:
    """Arrays of the kernels; sigma is constant, or tabulated over coarse cells when the camera has a detector model."""
    camera, sphere, limits, targets = task.camera, task.sphere, task.limits, task.scene.targets
    points = targets.points
    tags = len(targets.ids)
    weight, weight_grid = np.ones((1, len(points))), visibility.grid
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
        weight = (camera.sigma_px / sighting_sigma(camera, sphere.cameras(cells), targets)) ** 2
    longest = task.study.requirements.max_tour
    return SphereTables(
        points=blocked((points - sphere.centre).T),
        point_count=len(points),
        tags=tags,
        radius=sphere.radius,
        grid=visibility.grid,
        sure=visibility.sure,
        weight=np.pad(weight, ((0, 0), (0, -len(points) % LANES))),
        weight_grid=weight_grid,
        variance=float(camera.sigma_px**2 / (camera.focal_px**2).mean()),
        min_rays=limits.min_rays,
        min_tags=max(1, -(-limits.min_points_per_image // CORNERS_PER_TAG)),
        criterion=MAX_SIGMA if task.study.objectives.precision == "max_sigma" else MEAN_VARIANCE,
        longest=np.inf if longest is None or task.study.motion != "workspace" else 1e-3 * longest,
        limits=np.array([*sphere.azimuth, *sphere.elevation]),
    )


def joint_map_of(task: Task) -> JointMap | None:
    """The joints over a study's stations, None when motion is measured in the workspace.

    Raises:
        InfeasibleError: the robot cannot take an existing station.
    """
    if task.cell is None or task.study.motion == "workspace":
        return None
    joint_map = JointMap.build(task.cell, task.sphere, task.scene.part)
    refused = exact_options(joint_map, np.zeros((0, 2)), task.existing).refused
    if refused:
        stations = ", ".join(f"station {index + 1} ({reason})" for index, reason in refused)
        raise InfeasibleError(
            f"viewpoints.existing: the robot cannot take {len(refused)} of {len(task.existing)} existing stations:"
            f' {stations}; objectives.motion = "workspace" leaves the robot out'
        )
    return joint_map


def joint_tables(task: Task, joint_map: JointMap | None) -> JointTables | None:
    """What :func:`evaluation.joint_tours` reads, None when motion is measured in the workspace."""
    if joint_map is None or task.cell is None:
        return None
    timed, longest = task.study.motion == "time", task.study.requirements.max_tour
    return JointTables(
        arrays=joint_map.arrays,
        law=law_of(joint_map.arm),
        timed=timed,
        dwell=task.cell.dwell if timed else 0.0,
        longest=np.inf if longest is None else longest,
    )


def lattice_candidates(task: Task, visibility: VisibilityMap, joint_map: JointMap | None) -> Floats:
    """Return lattice viewpoints (c, 2) inside the range that the robot reaches and that see enough tags."""
    viewpoints = Chromosomes(sphere=task.sphere, slots=1).spread(CANDIDATES)
    if joint_map is not None:
        viewpoints = viewpoints[joint_map.reachable(viewpoints)]
    seen = visibility.sure_tags(visibility.cell_of(viewpoints)).sum(axis=1)
    return np.asarray(viewpoints[seen * CORNERS_PER_TAG >= max(task.limits.min_points_per_image, 1)])


def demanded_cover(
    task: Task, stations: Floats, sees: Bools, already: Ints, slots: int, visibility: VisibilityMap | None
) -> Cover:
    """Solve the set cover of what existing stations leave to see.

    Args:
        stations: (c, d) candidates.  sees: (c, g).  already: (g,) rays of the existing stations.
        slots: free images.  visibility: of the study, for the reasons; None when there is no map.

    Raises:
        InfeasibleError: no candidate sees enough, or a tag is seen from nowhere, or too many images are needed.
    """
    needed = np.maximum(task.limits.min_rays - already, 0)
    if len(stations) == 0:
        reach = "within reach of the robot " if task.cell is not None and task.study.motion != "workspace" else ""
        least = max(task.limits.min_points_per_image, CORNERS_PER_TAG)
        raise InfeasibleError(
            f"no viewpoint {reach}sees {least} object points for certain (visibility.min_points_per_image ="
            f" {task.limits.min_points_per_image}); `netdesign check` counts the reasons"
        )
    cover = smallest_cover(stations, sees, needed, slots)
    if needed.any() and not 0 < len(cover.viewpoints) <= slots:
        coverage(task, visibility).demand_feasible()
    return cover


def free_slots(task: Task) -> int:
    """Return how many images a search may place beside the existing ones.

    Raises:
        InputError: none.
    """
    most = min(task.sphere.max_images, task.study.requirements.max_images or task.sphere.max_images)
    if len(task.existing) >= most:
        raise InputError(
            f"viewpoints.existing: expected fewer stations than the {most} images that are allowed (max_images), found"
            f" {len(task.existing)}; `netdesign repair` says what they are worth"
        )
    return most - len(task.existing)


def on_sphere(task: Task) -> bool:
    """Tell whether every existing station is one of the viewing sphere's cameras (to 1 µm and 1e-5)."""
    if not len(task.existing):
        return True
    viewpoints, _ = task.sphere.placed(task.existing)
    if task.sphere.depth is not None or task.sphere.roll is None:
        return False
    inside = Chromosomes(sphere=task.sphere, slots=1).folded(viewpoints)
    own = task.sphere.cameras(inside)
    apart = np.abs(own - task.existing)
    return bool(apart[:, :3, 3].max() < 1e-6 and apart[:, :3, :3].max() < 1e-5)


def sphere_tours(task: Task, joint: JointTables | None, networks: Floats) -> Floats:
    """Return the tours (k,) of the search over networks (k, n, 2) on the sphere, stations out of reach left out."""
    if joint is None:
        return np.array([path_length(poses[:, :3, 3]) for poses in task.sphere.cameras(networks)])
    objectives = np.zeros((len(networks), 3))
    joint_tours(np.ones(networks.shape[:2], np.bool_), networks, joint, objectives, np.zeros(len(networks)))
    return objectives[:, 1]


def hypervolume_scale(task: Task, slots: int, tours: Callable[[Floats], Floats]) -> Floats:
    """Ideal and reference point of the hypervolume; tours: of networks (k, n, d), (k,).

    log f1 from the closed-form bound of ``slots`` images to 100 times it; f2 from 0 to the longest tour over ``slots``
    random stations in 20 samples; f3 from 1 to slots + 1.
    """
    camera, slots = task.camera, slots + len(task.existing)
    bound = 1.5 * float(camera.sigma_px**2 / (camera.focal_px**2).mean()) * (task.sphere.radius**2) / slots
    samples = Chromosomes(sphere=task.sphere, slots=slots).uniform(np.random.default_rng(0), (20, slots))
    longest = float(tours(samples).max())
    if task.study.objectives.precision == "max_sigma":
        ideal, reference = 0.5 * np.log(bound), 0.5 * np.log(100 * bound)
    else:
        ideal, reference = np.log(bound), np.log(100 * bound)
    return np.array([[ideal, 0.0, 1.0], [reference, max(longest, 1e-9), slots + 1.0]])
