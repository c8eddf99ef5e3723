"""Approximate values made better before the adjustment: the frame of the control points, intersected points.

What a user brings as a start may be rough (poses some degrees off), or in another frame than the control points. Two
repairs, each taken only where it explains the image points better than what was given:

* control frame: the model as it is, or carried by a similarity of its control points, given or intersected, to their
  known coordinates;
* points: as given, or intersected from the poses.

Where the adjustment fails all the same, points with nearly parallel rays wait until the poses are known.

The frame of a free network is not touched: its datum stays on the coordinates that the user gave.
"""

from dataclasses import replace

import numpy as np

from netdesign.adjustment.problem import BundleProblem
from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import similarity
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.intersection import convergence, intersect, viewing_rays

MISFIT_PX = 10.0  # scale of the robust misfit: what is much farther off counts little more
FAINT = np.radians(2.0) ** 2 / 4.0  # convergence of two rays at 2 degrees
BEHIND = 50.0  # misfit of a point behind its camera: worse than any that lies in front


def in_datum_frame(problem: BundleProblem) -> BundleProblem:
    """Return the problem with its approximations in the frame, or at the scale, of what carries the datum."""
    if problem.active_control is not None:
        return _in_control_frame(problem)
    if problem.active_priors is not None:
        return _in_prior_frame(problem)
    return problem if problem.active_bars is None else _at_bar_scale(problem)


def _in_control_frame(problem: BundleProblem) -> BundleProblem:
    """An arbitrary COLMAP frame is as good a start as any; with fewer than three whole control points it stays."""
    control = problem.active_control
    assert control is not None
    candidates = [(problem.world_from_cam, problem.points)]
    intersected, determined = _intersected(problem)
    for source, usable in (
        (problem.points[control.point], control.whole),
        (intersected[control.point], determined[control.point] & control.whole),
    ):
        if usable.sum() >= 3 and _not_on_one_line(source[usable]) and _not_on_one_line(control.xyz[usable]):
            candidates.append(_carried(problem, *similarity(source[usable], control.xyz[usable])))
    best, best_misfit = candidates[0], np.inf
    for poses, points in candidates:
        points = points.copy()
        points[control.point] = np.where(np.isfinite(control.sigma), control.xyz, points[control.point])
        # The control points alone tell whether the frame is theirs; the others moved with the poses.
        misfit = float(_misfits(replace(problem, world_from_cam=poses), points)[control.point].sum())
        if misfit < best_misfit:
            best, best_misfit = (poses, points), misfit
    return replace(problem, world_from_cam=best[0], points=best[1])


def _in_prior_frame(problem: BundleProblem) -> BundleProblem:
    """The model is carried to the priors' positions when it stands far from them."""
    priors = problem.active_priors
    assert priors is not None
    image, weight, _ = priors.weights
    known = weight > 0
    source, goal = problem.world_from_cam[image[known], :3, 3], priors.world_from_cam[known, :3, 3]
    if known.sum() < 3 or not _not_on_one_line(source) or not _not_on_one_line(goal):
        return problem
    moved = similarity(source, goal)
    left = float(((goal - (moved[0] * source @ moved[1].T + moved[2])) ** 2).sum())
    if float(((goal - source) ** 2).sum()) <= 100.0 * left:
        return problem
    poses, points = _carried(problem, *moved)
    return replace(problem, world_from_cam=poses, points=points)


def _at_bar_scale(problem: BundleProblem) -> BundleProblem:
    """The model is enlarged about its middle to the bars' lengths."""
    bars = problem.active_bars
    assert bars is not None
    length = np.linalg.norm(problem.points[bars.a] - problem.points[bars.b], axis=1)
    if not (length > 0).all():
        return problem
    scale = float(np.median(bars.length / length))
    centre = problem.middle()
    poses, points = _carried(problem, scale, np.eye(3), (1.0 - scale) * centre)
    return replace(problem, world_from_cam=poses, points=points)


def with_better_points(problem: BundleProblem) -> BundleProblem:
    """Return the problem with every point moved to its intersection where that explains its image points better."""
    found, determined = _intersected(problem)
    better = determined & (_misfits(problem, found) < _misfits(problem, problem.points)) & ~problem.known()
    return replace(problem, points=np.where(better[:, None], found, problem.points))


def without_faint_points(problem: BundleProblem) -> BundleProblem | None:
    """Return the problem without the image points of points whose rays are nearly parallel; None if there are none.

    Where such a point lies hangs on the base line between its stations, which rough poses do not even give the
    direction of: on its way the point would have to cross infinity, and the iteration stops before it.
    """
    observations = problem.observations
    intrinsics = problem.intrinsics[problem.camera_of_image[observations.image]]
    rays = viewing_rays(problem.world_from_cam[observations.image], observations.xy_px, intrinsics)
    faint = (convergence(rays, observations.point, len(problem.points)) < FAINT) & ~problem.known()
    faint_rows = faint[observations.point]
    return None if not faint_rows.any() else replace(problem, observations=observations.select(~faint_rows))


def _intersected(problem: BundleProblem) -> tuple[Floats, Bools]:
    """Return points (m, 3) intersected from the approximate poses, and which are determined."""
    observations = problem.observations
    poses = problem.world_from_cam[observations.image]
    intrinsics = problem.intrinsics[problem.camera_of_image[observations.image]]
    # About the stations' centroid: in national coordinates the normal equations would lose half their digits.
    centre = problem.world_from_cam[:, :3, 3].mean(axis=0)
    rays = viewing_rays(poses, observations.xy_px, intrinsics)
    found, determined = intersect(poses[:, :3, 3] - centre, rays, observations.point, len(problem.points))
    return found + centre, determined


def _misfits(problem: BundleProblem, points: Floats) -> Floats:
    """Return (m,) the sum over each point's image points of log(1 + d²/MISFIT_PX²), d their distance in px."""
    observations = problem.observations
    xy, depth = project(
        problem.world_from_cam[observations.image],
        points[observations.point],
        problem.intrinsics[problem.camera_of_image[observations.image]],
    )
    squared = ((observations.xy_px - xy) ** 2).sum(axis=1)
    misfit = np.where((depth > 0) & np.isfinite(squared), np.log1p(squared / MISFIT_PX**2), BEHIND)
    return np.bincount(observations.point, misfit, len(points)).astype(np.float64)


def _not_on_one_line(points: Floats) -> bool:
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[1] > 1e-6 * max(float(singular[0]), 1e-300))


def _carried(problem: BundleProblem, scale: float, rotation: Floats, translation: Floats) -> tuple[Floats, Floats]:
    """Return poses and points moved by a similarity."""
    poses = problem.world_from_cam.copy()
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + translation
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    return poses, scale * problem.points @ rotation.T + translation
