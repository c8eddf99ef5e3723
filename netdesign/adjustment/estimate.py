"""The bundle adjustment behind `netdesign adjust`: any datum, any interior parameters, reliability and diagnosis.

Own Gauss-Newton rather than a general solver, because an adjustment is its covariance: exactly the wanted unknowns
(fx tied to fy or not), exactly the wanted datum, error-free control without tight weights, and a diagnosis that names
what is not determined. GTSAM (``bundle``), Ceres and dense bordered normal equations confirm it in the tests.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from netdesign.adjustment.appraisal import anchored, appraise, free_parameters
from netdesign.adjustment.diagnosis import calibration_complaints, coinciding_images
from netdesign.adjustment.problem import BundleProblem, check_input, check_start, null_space
from netdesign.adjustment.snooping import cleaned
from netdesign.adjustment.solver import Iterations, Solution, equations, solve, unseen
from netdesign.adjustment.start import in_datum_frame, with_better_points, without_faint_points
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
    exact = _open_at(scaled)[0] if scaled.refine else ()
    if exact:
        raise InfeasibleError("; ".join(exact + calibration_complaints(scaled, scaled.refine, None)))

    def attempt(begin: BundleProblem) -> tuple[Solution, tuple[Rejection, ...], tuple[int, ...], int]:
        rejected: tuple[Rejection, ...] = ()
        dropped: tuple[int, ...] = ()
        before = 0
        if robust:
            begin, rejected, dropped, before = cleaned(with_better_points(begin), significance, sigma_known)
        return anchored(_solved(begin, progress), scaled.points), rejected, dropped, before

    # Plain least squares rarely needs more than rough poses. A robust start does: where points with nearly parallel
    # rays cannot get to their places, it settles with good image points given up.
    starts: tuple[Callable[[], BundleProblem | None], ...] = (
        lambda: scaled,
        lambda: _with_known_poses(scaled, progress),
    )
    failure: InfeasibleError | None = None
    for begin in reversed(starts) if robust else starts:
        start = begin()
        if start is None:
            continue
        try:
            solution, rejected, dropped, before = attempt(start)
            break
        except InfeasibleError as error:
            failure = failure or error
    else:
        weak = _open_at(scaled)[1] or calibration_complaints(scaled, scaled.refine, None)
        raise InfeasibleError("; ".join([str(failure), *coinciding_images(scaled), *weak]))
    adjustment = appraise(solution, unit, centre, joint, rejected, dropped)
    return replace(adjustment, iterations=adjustment.iterations + before)


def _with_known_poses(problem: BundleProblem, progress: Iterations) -> BundleProblem | None:
    """Return the problem with poses adjusted without the points whose rays are nearly parallel; None if that fails."""
    strong = without_faint_points(problem)
    if strong is None or not len(strong.observations):
        return None
    with suppress(InfeasibleError):
        found = solve(with_better_points(strong), robust=True, progress=progress).problem
        return replace(found, observations=problem.observations)
    return None


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
