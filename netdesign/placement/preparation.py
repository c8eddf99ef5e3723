"""What a search needs before it starts: the kernels' tables, the set cover, the scales of the hypervolume."""

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Floats, Ints
from netdesign.model.frames import sphere_directions
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_tour import law_of
from netdesign.motion.tour import path_length
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.limited_error import LANES, blocked
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.placement.coverage import coverage
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.evaluation import MAX_SIGMA, MEAN_VARIANCE, JointTables, SphereTables, joint_tours
from netdesign.placement.set_cover import CANDIDATES, Cover, smallest_cover
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
        in_joints=task.study.motion != "workspace",
        longest=np.inf if longest is None or task.study.motion != "workspace" else 1e-3 * longest,
        limits=np.array([*sphere.azimuth, *sphere.elevation]),
    )


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


def candidates(
    task: Task, visibility: VisibilityMap, joint_map: JointMap | None, tables: SphereTables
) -> tuple[Floats, Ints]:
    """Lattice viewpoints inside the range that the robot reaches and that see enough tags, and their cells."""
    viewpoints = Chromosomes(sphere=task.sphere, slots=1).spread(CANDIDATES)
    if joint_map is not None:
        viewpoints = viewpoints[joint_map.reachable(viewpoints)]
    cells = visibility.cell_of(viewpoints)
    enough = visibility.sure_tags(cells).sum(axis=1) >= tables.min_tags
    return viewpoints[enough], cells[enough]


def demanded_cover(task: Task, visibility: VisibilityMap, joint_map: JointMap | None, tables: SphereTables) -> Cover:
    """Solve the set cover.

    Raises:
        InfeasibleError: no candidate sees enough, or a tag is seen from nowhere, or too many images are needed.
    """
    viewpoints, cells = candidates(task, visibility, joint_map, tables)
    if len(viewpoints) == 0:
        raise InfeasibleError(
            f"no viewpoint {'within reach of the robot ' if joint_map else ''}sees {tables.min_tags} tags"
            f" (min_points_per_image = {task.limits.min_points_per_image}); `netdesign check` counts the reasons"
        )
    cover = smallest_cover(viewpoints, visibility.sure_tags(cells), tables.min_rays, task.sphere.max_images)
    if len(cover.viewpoints) == 0 or len(cover.viewpoints) > task.sphere.max_images:
        coverage(task, visibility).demand_feasible()
    return cover


def hypervolume_scale(task: Task, tables: SphereTables, joint: JointTables | None, slots: int) -> Floats:
    """Ideal and reference point of the hypervolume.

    log f1 from the closed-form bound of ``slots`` images to 100 times it; f2 from 0 to the longest tour over ``slots``
    random stations in 20 samples; f3 from 1 to slots + 1.
    """
    bound = 1.5 * tables.variance * (task.sphere.radius**2) / slots
    samples = Chromosomes(sphere=task.sphere, slots=slots).uniform(np.random.default_rng(0), (20, slots))
    if joint is None:
        longest = max(tables.radius * path_length(directions) for directions in sphere_directions(samples))
    else:
        objectives = np.zeros((len(samples), 3))
        joint_tours(np.ones(samples.shape[:2], np.bool_), samples, joint, objectives, np.zeros(len(samples)))
        longest = float(objectives[:, 1].max())
    if tables.criterion == MAX_SIGMA:
        ideal, reference = 0.5 * np.log(bound), 0.5 * np.log(100 * bound)
    else:
        ideal, reference = np.log(bound), np.log(100 * bound)
    return np.array([[ideal, 0.0, 1.0], [reference, max(longest, 1e-9), slots + 1.0]])
