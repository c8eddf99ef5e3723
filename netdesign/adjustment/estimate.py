"""The bundle adjustment behind `netdesign adjust`: any datum, any interior parameters, reliability and diagnosis.

Own Gauss-Newton rather than a general solver, because an adjustment is its covariance: exactly the wanted unknowns
(fx tied to fy or not), exactly the wanted datum, error-free control without tight weights, and a diagnosis that names
what is not determined. GTSAM (``bundle``), Ceres and dense bordered normal equations confirm it in the tests.
"""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from netdesign.adjustment.covariance import datum_covariance
from netdesign.adjustment.diagnosis import (
    calibration_complaints,
    coinciding_images,
    depth_weakness,
    point_complaints,
    quality_warnings,
)
from netdesign.adjustment.problem import BundleProblem, check_input, check_start, null_space
from netdesign.adjustment.snooping import cleaned
from netdesign.adjustment.solver import Solution, equations, solve
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Adjustment, Rejection
from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import similarity
from netdesign.photogrammetry.connectivity import listed, named, numeric_complaints
from netdesign.photogrammetry.datum import datum_operator
from netdesign.photogrammetry.normals import invert_camera_side, reduce_normals
from netdesign.photogrammetry.observation_equations import Layout, whitener
from netdesign.photogrammetry.reliability import redundancy_matrices, redundancy_numbers


def estimate(
    problem: BundleProblem,
    robust: bool = False,
    significance: float = 1e-3,
    joint: bool = False,
    sigma_known: bool = True,
) -> Adjustment:
    """Adjust a bundle.

    Args:
        robust: start with Cauchy weights and remove gross errors by a w-test before the least-squares solution.
        significance: of the outlier test.
        joint: also form the joint covariance of all points.
        sigma_known: False when the covariances of the image points are a guess; the outlier test then scales itself.

    Raises:
        InputError: values that are no numbers, observations given twice, a datum without what carries it.
        InfeasibleError: the network does not determine what is asked for, or the iteration does not converge; the
            message names the images, points or parameters.
    """
    check_input(problem)
    scaled, unit, centre = problem.in_control_frame().normalised()
    check_start(scaled)
    start = scaled.points
    rejected: tuple[Rejection, ...] = ()
    dropped: tuple[int, ...] = ()
    before = 0
    exact = _open_at(scaled)[0] if scaled.refine else ()
    if exact:
        raise InfeasibleError("; ".join(exact + calibration_complaints(scaled, scaled.refine, None)))
    try:
        if robust:
            scaled, rejected, dropped, before = cleaned(scaled, significance, sigma_known)
        solution = anchored(solve(scaled), start)
    except InfeasibleError as error:
        weak = _open_at(scaled)[1] or calibration_complaints(scaled, scaled.refine, None)
        raise InfeasibleError("; ".join([str(error), *coinciding_images(scaled), *weak])) from None
    adjustment = appraise(solution, unit, centre, joint, rejected, dropped)
    return replace(adjustment, iterations=adjustment.iterations + before)


def _open_at(problem: BundleProblem) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what the normal equations leave open at the approximate values, and weakly determined parameters."""
    layout = problem.layout()
    linearised, rows = equations(problem, layout, whitener(problem.observations.covariance))
    names = _parameter_names(problem)
    camera_side = invert_camera_side(reduce_normals(linearised), null_space(problem, layout)[0], rows[:, :-1])
    first, last = 6 * layout.images, int(layout.parameter_start[-1])
    weak = calibration_complaints(problem, names, camera_side.inverse[first:last, first:last])
    return numeric_complaints(camera_side, layout.images, problem.image_names, names), weak


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
    if problem.datum in ("control", "fixed") and open_:
        raise InfeasibleError(
            f"datum {problem.datum}: {len(problem.known().nonzero()[0])} control point(s) leave {open_} of 7 datum "
            "parameters open; expected at least 3 that do not lie on one line"
        )
    parameter_names = _parameter_names(problem)
    unknowns = layout.width + 3 * int(layout.eliminated.sum())
    measured = _measured(problem, layout)
    redundancy = measured - unknowns + open_
    sigma0 = float(np.sqrt(solution.cost / redundancy)) if redundancy > 0 else float("nan")
    # With enough redundancy the residuals know the noise better than an assumption does: its upper 99.5 % bound.
    noise = sigma0 / np.sqrt(chi2.ppf(0.005, redundancy) / redundancy) if redundancy >= 20 else 1.0
    weakness = depth_weakness(problem, layout, reduced) * float(noise)
    complaints = point_complaints(problem, layout, reduced, weakness)
    if complaints:
        raise InfeasibleError("; ".join(complaints))
    camera_side = invert_camera_side(reduced, g_camera, solution.constraints)
    complaints = numeric_complaints(camera_side, layout.images, problem.image_names, parameter_names)
    if complaints:
        raise InfeasibleError("; ".join(complaints + calibration_complaints(problem, parameter_names, None)))
    mask = datum_mask(problem, layout)
    try:
        operator = datum_operator(problem.points, mask, g_points)
    except ValueError as error:
        raise InfeasibleError(str(error)) from None
    covariance = datum_covariance(reduced, camera_side, layout, g_camera, g_points, operator, with_joint)
    first, last = 6 * layout.images, int(layout.parameter_start[-1])
    parameter_covariance = covariance.camera[first:last, first:last]
    complaints = calibration_complaints(problem, parameter_names, parameter_covariance)
    if complaints:
        raise InfeasibleError("; ".join(complaints))
    red = redundancy_matrices(linearised, reduced, camera_side.inverse)
    numbers = redundancy_numbers(red)
    used = layout.eliminated | layout.kept | problem.known()
    point_covariance = covariance.points * unit**2
    point_covariance[~used] = np.inf
    joint = None if covariance.joint is None else covariance.joint * unit**2
    if joint is not None:
        joint[np.repeat(~used, 3), np.repeat(~used, 3)] = np.inf
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
        point_covariance=point_covariance,
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
    return replace(adjustment, warnings=quality_warnings(problem, adjustment, dropped, weakness))


def _measured(problem: BundleProblem, layout: Layout) -> int:
    """Return the number of measured values: image coordinates, weighted control coordinates, lengths, priors."""
    control, bars = problem.active_control, problem.active_bars
    count = 2 * len(problem.observations)
    count += 0 if control is None else 3 * int((control.sigma > 0).sum())
    count += 0 if bars is None else len(bars.a)
    return count + (0 if problem.active_priors is None else 6 * layout.images)


def _parameter_names(problem: BundleProblem) -> tuple[str, ...]:
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
    bars = problem.active_bars
    lengths = "" if bars is None else f"{len(bars.a)} scale bar(s)"
    if problem.datum == "scale":
        return f"scale: inner constraints ({open_}) over {chosen}, scale from {lengths}"
    control = problem.active_control
    assert control is not None
    weighted = int((control.sigma > 0).sum())
    counts = ((len(control.sigma) - weighted, "error-free"), (weighted, "weighted"))
    kinds = [f"{count} {kind}" for count, kind in counts if count]
    text = f"{problem.datum}: {' and '.join(kinds)} control points"
    return text + (f", {lengths}" if lengths else "") + (", pose priors" if problem.active_priors is not None else "")
