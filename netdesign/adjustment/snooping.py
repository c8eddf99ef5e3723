"""Gross errors: a robust start, then data snooping with a 2-dof w-test, one image point of an object point at a time.

Robust weights only find the suspects; what decides is the test on least-squares residuals, and what remains is
adjusted with full weights. An object point that lost rays and keeps fewer than three is dropped: with two rays an
error along the epipolar line cannot be seen.
"""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from netdesign.adjustment.problem import BundleProblem, null_space
from netdesign.adjustment.solver import Solution, cost_parts, solve
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Rejection
from netdesign.model.arrays import Bools, Floats
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.normals import invert_camera_side, reduce_normals
from netdesign.photogrammetry.observation_equations import whitener
from netdesign.photogrammetry.reliability import redundancy_matrices, w_statistic

SUSPECT = 25.0  # squared whitened residual of the robust solution above which an image point is set aside
ROUNDS = 30
FAR = 10.0  # median squared whitened residual above which approximations are rough
NARROWER = 25.0
CONTROLLED = 3  # rays that an object point needs for its errors to be found


def cleaned(
    problem: BundleProblem, significance: float, sigma_known: bool = True
) -> tuple[BundleProblem, tuple[Rejection, ...], tuple[int, ...], int]:
    """Return the problem without gross errors, what was rejected, the points that were dropped, and iterations spent.

    Args:
        sigma_known: False when the covariances are a guess; the level of the noise is then taken from the residuals.

    Raises:
        InfeasibleError: more than half of the image points would have to go.
    """
    original = problem.observations
    limit = float(chi2.isf(significance, 2))
    robust, iterations = _from_afar(problem)
    if not sigma_known:
        for _ in range(3):
            guess = _robust_variance((robust.linearised.residual**2).sum(axis=1), robust.problem)
            observations = replace(problem.observations, covariance=problem.observations.covariance * guess)
            problem = replace(problem, observations=observations)
            robust = solve(replace(robust.problem, observations=observations), robust=True)
            iterations += robust.iterations
    everything = problem.observations
    squared = (robust.linearised.residual**2).sum(axis=1)
    level = _variance_level(squared, problem)
    keep = _with_enough_rays(problem, squared <= SUSPECT * level)
    statistic = squared / level
    start = robust.problem
    returned = np.zeros(len(keep), dtype=np.bool_)
    solution = robust
    for _ in range(ROUNDS):
        if keep.sum() < 0.5 * len(keep):
            raise InfeasibleError(
                f"{int((~keep).sum())} of {len(keep)} image points look like gross errors: "
                "check the approximate values and sigma_px"
            )
        solution = solve(replace(start, observations=everything.select(keep)))
        iterations += solution.iterations
        start = replace(solution.problem, observations=everything)
        test, level = _tests(solution)
        current = np.zeros(len(keep))
        current[keep] = test
        bad = keep & (current > limit)
        worst = np.zeros(len(start.points))
        np.maximum.at(worst, everything.point[bad], current[bad])
        remove = bad & (current >= worst[everything.point])
        if remove.any():
            statistic[remove] = current[remove]
            keep = _with_enough_rays(problem, keep & ~remove)
            continue
        back = ~keep & ~returned & (_prediction_test(start, ~keep, level) <= limit)
        back &= _with_enough_rays(problem, keep | back)
        if not back.any():
            break
        keep, returned = keep | back, returned | back
    lost = ~keep
    rays = np.bincount(everything.point[keep], minlength=len(problem.points))
    gone = np.unique(everything.point[lost])
    dropped = tuple(int(j) for j in gone if rays[j] == 0)
    rejections = tuple(
        Rejection(image=int(everything.image[k]), point=int(everything.point[k]), statistic=float(statistic[k]))
        for k in np.flatnonzero(lost)
    )
    return replace(start, observations=original.select(keep)), rejections, dropped, iterations


def _from_afar(problem: BundleProblem) -> tuple[Solution, int]:
    """Return the robust solution and the iterations spent, approached with weights that narrow step by step.

    Cauchy's weights look for the image points that agree to their sigma. From rough approximations, where none does,
    they settle on those that happen to: a few of a weak image with a gross error among them. With sigmas as large as
    the residuals are, all good points speak first (graduated non-convexity).
    """
    observations, iterations = problem.observations, 0
    factor = float(np.median(cost_parts(problem, whitener(observations.covariance))[0]))
    while factor > FAR:
        wider = replace(observations, covariance=observations.covariance * factor)
        try:
            found = solve(replace(problem, observations=wider), robust=True)
        except InfeasibleError:
            break  # the narrow weights may get there all the same
        iterations += found.iterations
        problem = replace(found.problem, observations=observations)
        factor /= NARROWER
    robust = solve(problem, robust=True)
    return robust, iterations + robust.iterations


def _with_enough_rays(problem: BundleProblem, keep: Bools) -> Bools:
    """Return ``keep`` without the points that lost rays and have fewer than CONTROLLED left (control excepted)."""
    point = problem.observations.point
    before = np.bincount(point, minlength=len(problem.points))
    after = np.bincount(point[keep], minlength=len(problem.points))
    short = (after < before) & (after < CONTROLLED) & ~problem.known()
    return keep & ~short[point]


def _robust_variance(squared: Floats, problem: BundleProblem) -> float:
    """Return the variance factor of squared whitened residuals (k,), from their median.

    The median of chi² (2) is 2 ln 2; residuals are smaller than errors by the mean redundancy number.
    """
    layout = problem.layout()
    unknowns = layout.width + 3 * int(layout.eliminated.sum()) - null_space(problem, layout)[0].shape[1]
    share = max(1.0 - unknowns / (2 * len(squared)), 0.05)
    return float(max(np.median(squared) / (2.0 * np.log(2.0) * share), 1e-12))


def _variance_level(squared: Floats, problem: BundleProblem) -> float:
    """Return the variance factor that tests are scaled by: 1 unless the residuals clearly say more.

    Less is never used: it would reject good image points.
    """
    level = _robust_variance(squared, problem)
    # The median of k squares has a relative deviation of about 1.44/sqrt(k): four of these are chance.
    return level if level > 1.0 + 6.0 / np.sqrt(len(squared)) else 1.0


def _tests(solution: Solution) -> tuple[Floats, float]:
    """Return the w-test statistics (k,) of a least-squares solution and the variance factor they are scaled by."""
    problem, linearised = solution.problem, solution.linearised
    layout = problem.layout()
    reduced = reduce_normals(linearised)
    gauge, _ = null_space(problem, layout)
    camera_side = invert_camera_side(reduced, gauge, solution.constraints)
    red = redundancy_matrices(linearised, reduced, camera_side.inverse)
    squared = (linearised.residual**2).sum(axis=1)
    level = _variance_level(squared, problem)
    return w_statistic(linearised.residual, red) / level, level


def _prediction_test(problem: BundleProblem, removed: Bools, level: float) -> Floats:
    """Return squared whitened residuals (k,) of removed image points at the estimates; inf for the others."""
    everything = problem.observations
    result = np.full(len(removed), np.inf)
    rows = everything.select(removed)
    if len(rows) == 0:
        return result
    xy, _ = project(
        problem.world_from_cam[rows.image],
        problem.points[rows.point],
        problem.intrinsics[problem.camera_of_image[rows.image]],
    )
    residual = np.einsum("kij,kj->ki", whitener(rows.covariance), rows.xy_px - xy)
    result[removed] = (residual**2).sum(axis=1) / level
    return result
