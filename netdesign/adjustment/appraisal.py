"""From a converged solution to an adjustment: datum, covariances, reliability, diagnosis."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from netdesign.adjustment.covariance import DatumCovariance, datum_covariance
from netdesign.adjustment.diagnosis import (
    calibration_complaints,
    depth_weakness,
    network_complaints,
    point_complaints,
    quality_warnings,
    undetermined_points,
)
from netdesign.adjustment.problem import BundleProblem, null_space
from netdesign.adjustment.solver import Solution, equations
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Adjustment, Rejection
from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import similarity
from netdesign.photogrammetry.connectivity import listed, named, numeric_complaints
from netdesign.photogrammetry.datum import datum_operator, point_null_space, pose_null_space
from netdesign.photogrammetry.normals import CameraSide, Reduced, invert_camera_side, reduce_normals
from netdesign.photogrammetry.observation_equations import Layout, whitener
from netdesign.photogrammetry.reliability import redundancy_matrices, redundancy_numbers

ENOUGH = 20  # redundancy from which on the residuals know the noise better than an assumption does


def datum_mask(problem: BundleProblem, layout: Layout) -> Bools:
    """Return (m,): the points that carry the inner constraints."""
    observed = layout.eliminated | layout.kept
    return observed if problem.datum_points is None else observed & problem.datum_points


def anchored(solution: Solution, start: Floats) -> Solution:
    """Return the solution carried to the frame of the datum points' approximate coordinates (Helmert, unweighted)."""
    problem = solution.problem
    layout = problem.layout()
    _, g_points = null_space(problem, layout)
    if g_points.shape[1] < 6:
        return solution
    mask = datum_mask(problem, layout)
    if mask.sum() < 3:
        raise InfeasibleError(f"datum points: expected at least 3 observed ones, found {int(mask.sum())}")
    scale, rotation, translation = similarity(problem.points[mask], start[mask], with_scale=g_points.shape[1] == 7)
    poses = problem.world_from_cam.copy()
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + translation
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    points = scale * problem.points @ rotation.T + translation
    problem = replace(problem, world_from_cam=poses, points=points)
    linearised, rows = equations(problem, layout, whitener(problem.observations.covariance))
    return replace(solution, problem=problem, linearised=linearised, constraints=rows[:, :-1])


def appraise(
    solution: Solution,
    unit: float,
    centre: Floats,
    with_joint: bool,
    rejected: tuple[Rejection, ...],
    dropped: tuple[int, ...],
) -> Adjustment:
    """Return the adjustment that belongs to a solution in normalised units.

    Args:
        solution: at the minimum, in the frame of its datum.  unit, centre: of ``BundleProblem.normalised``.

    Raises:
        InfeasibleError: something besides the datum is not determined.
    """
    problem, linearised = solution.problem, solution.linearised
    layout = problem.layout()
    reduced = reduce_normals(linearised)
    g_camera, g_points = null_space(problem, layout)
    open_ = g_camera.shape[1]
    parameter_names = free_parameters(problem)
    unknowns = layout.width + 3 * int(layout.eliminated.sum())
    measured = _measured(problem, layout)
    redundancy = measured - unknowns + open_
    sigma0 = float(np.sqrt(solution.cost / redundancy)) if redundancy > 0 else float("nan")
    noise = sigma0 / np.sqrt(chi2.ppf(0.005, redundancy) / redundancy) if redundancy >= ENOUGH else 1.0
    weakness = depth_weakness(problem, layout, reduced) * float(noise)
    lost = undetermined_points(layout, reduced, weakness)
    _refuse(point_complaints(problem, layout, lost))
    camera_side = invert_camera_side(reduced, g_camera, solution.constraints)
    complaints = numeric_complaints(camera_side, layout.images, problem.image_names, parameter_names)
    _refuse(complaints and complaints + calibration_complaints(problem, parameter_names, None))
    mask = datum_mask(problem, layout)
    covariance = _in_datum(problem, layout, reduced, camera_side, g_camera, g_points, mask, with_joint)
    # The scale is transformed away only where image points alone would have to give it.
    parts = problem, layout, reduced, camera_side, covariance
    inner = _inner_blocks(*parts, open_, parameters=7 if open_ == 7 else 6)
    shape = inner if open_ == 7 else _inner_blocks(*parts, open_, parameters=7)
    _refuse(network_complaints(problem, layout, shape, lost, float(noise)))
    first, last = 6 * layout.images, int(layout.parameter_start[-1])
    parameter_covariance = covariance.camera[first:last, first:last]
    _refuse(calibration_complaints(problem, parameter_names, parameter_covariance))
    numbers = redundancy_numbers(redundancy_matrices(linearised, reduced, camera_side.inverse))
    used = (layout.eliminated | layout.kept | problem.known()) & ~lost
    blocks = [covariance.points * unit**2, inner * unit**2]
    for block in blocks:
        block[~used] = np.inf
    joint = None if covariance.joint is None else covariance.joint * unit**2
    if joint is not None:
        without = np.repeat(~used, 3)
        joint[without, without] = np.inf
    turn = np.r_[np.ones(3), np.full(3, unit)]  # rotations have no unit of length
    pose_blocks = covariance.camera[:first, :first].reshape(layout.images, 6, layout.images, 6)
    index = np.arange(layout.images)
    poses = problem.world_from_cam.copy()
    poses[:, :3, 3] = poses[:, :3, 3] * unit + centre
    projected = np.einsum("kij,kj->ki", np.linalg.inv(whitener(problem.observations.covariance)), linearised.residual)
    adjustment = Adjustment(
        world_from_cam=poses,
        points=problem.points * unit + centre,
        intrinsics=problem.intrinsics,
        camera_of_image=problem.camera_of_image,
        observations=problem.observations,
        residuals_px=projected,
        redundancy_numbers=numbers,
        extra_redundancy=float(redundancy - numbers.sum()),
        point_covariance=blocks[0],
        inner_covariance=blocks[1],
        joint_covariance=joint,
        pose_covariance=pose_blocks[index, :, index, :] * turn[:, None] * turn[None, :],
        parameter_names=parameter_names,
        parameter_covariance=parameter_covariance,
        sigma0=sigma0,
        n_observations=measured,
        n_unknowns=unknowns,
        n_datum=open_,
        redundancy=redundancy,
        datum=_datum_text(problem, mask, open_),
        used=used,
        iterations=solution.iterations,
        converged=True,
        lambda8=camera_side.first_eigenvalue,
        rejected=rejected,
    )
    return replace(adjustment, warnings=quality_warnings(problem, adjustment, dropped, weakness, lost))


def _refuse(complaints: tuple[str, ...]) -> None:
    if complaints:
        raise InfeasibleError("; ".join(complaints))


def _in_datum(
    problem: BundleProblem,
    layout: Layout,
    reduced: Reduced,
    camera_side: CameraSide,
    g_camera: Floats,
    g_points: Floats,
    mask: Bools,
    with_joint: bool,
) -> DatumCovariance:
    """Return the covariances with the open parameters ``g`` fixed by inner constraints over the points ``mask``."""
    try:
        operator = datum_operator(problem.points, mask, g_points)
    except ValueError as error:
        raise InfeasibleError(str(error)) from None
    return datum_covariance(reduced, camera_side, layout, g_camera, g_points, operator, with_joint)


def _inner_blocks(
    problem: BundleProblem,
    layout: Layout,
    reduced: Reduced,
    camera_side: CameraSide,
    covariance: DatumCovariance,
    open_: int,
    parameters: int,
) -> Floats:
    """Return the points' covariances (m, 3, 3) by S-transformation to inner constraints over all adjusted points.

    What is left is the inner precision of the network: without the uncertainty of the frame that control points or
    priors bring in.
    """
    adjusted = layout.eliminated | layout.kept
    if adjusted.sum() < 3 or (open_ == parameters and problem.datum_points is None):
        return covariance.points.copy()
    g_camera = np.zeros((layout.width, parameters))
    origin = problem.middle()
    g_points = point_null_space(problem.points, origin, parameters)
    g_camera[: 6 * layout.images] = pose_null_space(problem.world_from_cam, origin, parameters)
    g_camera[int(layout.parameter_start[-1]) :] = g_points.reshape(-1, 3, parameters)[layout.kept].reshape(
        -1, parameters
    )
    return _in_datum(problem, layout, reduced, camera_side, g_camera, g_points, adjusted, False).points


def _measured(problem: BundleProblem, layout: Layout) -> int:
    """Return the number of measured values: image coordinates, weighted control coordinates, lengths, priors."""
    control, bars, priors = problem.active_control, problem.active_bars, problem.active_priors
    count = 2 * len(problem.observations)
    count += 0 if control is None else int(((control.sigma > 0) & np.isfinite(control.sigma)).sum())
    count += 0 if bars is None else len(bars.a)
    return count + (0 if priors is None else 3 * sum(int((weight > 0).sum()) for weight in priors.weights[1:]))


def free_parameters(problem: BundleProblem) -> tuple[str, ...]:
    """Return the names of the free interior parameters, camera by camera."""
    if len(problem.intrinsics) == 1:
        return problem.refine
    return tuple(f"camera {index + 1} {name}" for index in range(len(problem.intrinsics)) for name in problem.refine)


def _datum_text(problem: BundleProblem, mask: Bools, open_: int) -> str:
    """Return the datum in words, the one that every sigma refers to."""
    chosen = "all object points"
    if problem.datum_points is not None:
        chosen = f"{int(mask.sum())} chosen points ({listed(named(problem.point_names, mask))})"
    if problem.datum == "free":
        return f"free: inner constraints over {chosen}"
    bars, priors, control = problem.active_bars, problem.active_priors, problem.active_control
    lengths = "" if bars is None else f"{len(bars.a)} scale bar(s)"
    if problem.datum == "scale":
        return f"scale: inner constraints ({open_}) over {chosen}, scale from {lengths}"
    parts = []
    if control is not None:
        weighted = int((~control.exact).sum())
        counts = ((len(control.sigma) - weighted, "error-free"), (weighted, "weighted"))
        parts.append(" and ".join(f"{count} {kind}" for count, kind in counts if count) + " control points")
    if priors is not None:
        parts.append(f"{len(priors.world_from_cam)} pose priors")
    return f"{problem.datum}: " + ", ".join([*parts, *([lengths] if lengths else [])])
