"""The bundle adjustment behind `netdesign adjust`: any datum, any interior parameters, reliability and diagnosis.

Own Gauss-Newton rather than a general solver, because an adjustment is its covariance: exactly the wanted unknowns
(fx tied to fy or not), exactly the wanted datum, error-free control without tight weights, and a diagnosis that names
what is not determined. GTSAM (``bundle``), Ceres and dense bordered normal equations confirm it in the tests.
"""

from dataclasses import replace

from netdesign.adjustment.appraisal import anchored, appraise, free_parameters
from netdesign.adjustment.diagnosis import calibration_complaints, coinciding_images
from netdesign.adjustment.problem import BundleProblem, check_input, check_start, null_space
from netdesign.adjustment.snooping import cleaned
from netdesign.adjustment.solver import Iterations, Solution, equations, solve, unseen
from netdesign.adjustment.start import in_datum_frame, with_better_points
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Adjustment, Rejection
from netdesign.photogrammetry.connectivity import numeric_complaints
from netdesign.photogrammetry.normals import invert_camera_side, reduce_normals
from netdesign.photogrammetry.observation_equations import whitener


def estimate(
    problem: BundleProblem,
    robust: bool = False,
    significance: float = 1e-3,
    joint: bool = False,
    sigma_known: bool = True,
    progress: Iterations = unseen,
) -> Adjustment:
    """Adjust a bundle.

    Args:
        robust: start with Cauchy weights and remove gross errors by a w-test before the least-squares solution.
        significance: of the outlier test.
        joint: also form the joint covariance of all points.
        sigma_known: False when the covariances of the image points are a guess; the outlier test then scales itself.
        progress: told the iteration and the sum of squares before each one.

    Raises:
        InputError: values that are no numbers, observations given twice, a datum without what carries it.
        InfeasibleError: the network does not determine what is asked for, or the iteration does not converge; the
            message names the images, points or parameters.
    """
    check_input(problem)
    scaled, unit, centre = in_datum_frame(problem).normalised()
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
            scaled, rejected, dropped, before = cleaned(with_better_points(scaled), significance, sigma_known)
        solution = anchored(_solved(scaled, progress), start)
    except InfeasibleError as error:
        weak = _open_at(scaled)[1] or calibration_complaints(scaled, scaled.refine, None)
        raise InfeasibleError("; ".join([str(error), *coinciding_images(scaled), *weak])) from None
    adjustment = appraise(solution, unit, centre, joint, rejected, dropped)
    return replace(adjustment, iterations=adjustment.iterations + before)


def _solved(problem: BundleProblem, progress: Iterations) -> Solution:
    """Return the least-squares solution; where it is not reached at once, robust weights go first.

    Raises:
        InfeasibleError: the iteration does not converge from any of these starts.
    """
    better = with_better_points(problem)
    try:
        return solve(better, progress=progress)
    except InfeasibleError as error:
        try:
            return solve(solve(better, robust=True, progress=progress).problem, progress=progress)
        except InfeasibleError:
            raise error from None


def _open_at(problem: BundleProblem) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what the normal equations leave open at the approximate values, and weakly determined parameters."""
    layout = problem.layout()
    linearised, rows = equations(problem, layout, whitener(problem.observations.covariance))
    names = free_parameters(problem)
    camera_side = invert_camera_side(reduce_normals(linearised), null_space(problem, layout)[0], rows[:, :-1])
    first, last = 6 * layout.images, int(layout.parameter_start[-1])
    weak = calibration_complaints(problem, names, camera_side.inverse[first:last, first:last])
    return numeric_complaints(camera_side, layout.images, problem.image_names, names), weak
