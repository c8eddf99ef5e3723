"""Levenberg-Marquardt on the reduced normal equations: exactly the wanted unknowns, exactly the given weights.

Robust weights are Cauchy's, w = 1 / (1 + |e|²/c²) with c = 2.3849 on the whitened residual of an image point (2 dof).
They serve as a start only: a covariance from robust weights is none, see ``estimate``.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from netdesign.adjustment.problem import BundleProblem, null_space
from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Floats
from netdesign.model.frames import exp_rotation
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.normals import Linearised, reduce_normals
from netdesign.photogrammetry.observation_equations import Layout, linearise, whitener

CAUCHY = 2.3849
MOST_ITERATIONS = 200
FIRST_DAMPING = 1e-6
CLOSE = 1e-3  # length of a step, in standard deviations, from which on the cost no longer judges it
SETTLED = 0.1  # length of a robust step, in standard deviations, from which on a cost that hardly falls ends it
HARDLY = 1e-2, 1e-6  # what a robust step must still take off the cost, absolute and of the cost
STEP = 1e-7  # length of the last Gauss-Newton step, in standard deviations of all unknowns together


Iterations = Callable[[int, float], None]


def unseen(iteration: int, cost: float) -> None:
    """Show nothing: the default."""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Estimates of a converged adjustment, in the frame the iteration ended in.

    Attributes:
        problem: the problem with the estimates in place of the approximations.
        linearised: observation equations at the estimates, with weight 1.  constraints: (b, W) of error-free bars.
        cost: vᵀPv with robust weights switched off, control, bars and priors included.
    """

    problem: BundleProblem
    linearised: Linearised
    constraints: Floats
    cost: float
    iterations: int


def _extra_equations(problem: BundleProblem, layout: Layout, linearised: Linearised) -> tuple[Linearised, Floats]:
    """Return the equations with control, bars and priors added, and the error-free bars' rows [H | misclosure]."""
    point_prior, point_rhs = linearised.point_prior.copy(), linearised.point_prior_rhs.copy()
    camera_prior, camera_rhs = linearised.camera_prior.copy(), linearised.camera_prior_rhs.copy()
    control, bars, priors = problem.active_control, problem.active_bars, problem.active_priors
    if control is not None:
        weighted = ~control.exact
        index, weight = control.point[weighted], control.sigma[weighted] ** -2.0
        offset = control.xyz[weighted] - problem.points[index]
        for j, w, d in zip(index.tolist(), weight, offset, strict=True):
            if layout.kept[j]:
                start = int(layout.kept_start[j])
                camera_prior[range(start, start + 3), range(start, start + 3)] += w
                camera_rhs[start : start + 3] += w * d
            else:
                point_prior[j] += np.diag(w)
                point_rhs[j] += w * d
    rows: list[Floats] = []
    if bars is not None:
        for a, b, length, sigma in zip(
            bars.a.tolist(), bars.b.tolist(), bars.length.tolist(), bars.sigma.tolist(), strict=True
        ):
            difference = problem.points[a] - problem.points[b]
            distance = float(np.linalg.norm(difference))
            row = np.zeros(layout.width + 1)
            for j, sign in ((a, 1.0), (b, -1.0)):
                if layout.kept[j]:
                    start = int(layout.kept_start[j])
                    row[start : start + 3] = sign * difference / distance
            row[-1] = length - distance
            if sigma == 0:
                if row[:-1].any():  # between two fixed points there is nothing to adjust
                    rows.append(row)
            else:
                camera_prior += np.outer(row[:-1], row[:-1]) / sigma**2
                camera_rhs += row[:-1] * row[-1] / sigma**2
    if priors is not None:
        residual, jacobian = _pose_priors(problem)
        for i, r, j in zip(priors.weights[0].tolist(), residual, jacobian, strict=True):
            here = slice(6 * i, 6 * i + 6)
            camera_prior[here, here] += j.T @ j
            camera_rhs[here] += j.T @ r
    extended = replace(
        linearised,
        point_prior=point_prior,
        point_prior_rhs=point_rhs,
        camera_prior=camera_prior,
        camera_prior_rhs=camera_rhs,
    )
    return extended, np.array(rows).reshape(-1, layout.width + 1)


def _pose_priors(problem: BundleProblem) -> tuple[Floats, Floats]:
    """Return the whitened residuals (p, 6) prior - estimate and the derivatives (p, 6, 6) of the estimates.

    The rotation vector of a deviation is taken as the axial part of its matrix, sin instead of the angle: exact to
    second order in the deviation, which is all that a prior needs.
    """
    priors = problem.active_priors
    assert priors is not None
    image, position, rotation = priors.weights
    estimate = problem.world_from_cam[image]
    turn = np.swapaxes(priors.world_from_cam[:, :3, :3], 1, 2) @ estimate[:, :3, :3]
    omega = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    jacobian = np.zeros((len(image), 6, 6))
    trace = np.trace(turn, axis1=1, axis2=2)[:, None, None]
    jacobian[:, :3, :3] = 0.5 * (trace * np.eye(3) - np.swapaxes(turn, 1, 2)) * rotation[:, None, None]
    jacobian[:, 3:, 3:] = estimate[:, :3, :3] * position[:, None, None]
    offset = priors.world_from_cam[:, :3, 3] - estimate[:, :3, 3]
    return np.concatenate([-omega * rotation[:, None], offset * position[:, None]], axis=1), jacobian


def cost_parts(problem: BundleProblem, whiten: Floats) -> tuple[Floats, float, Floats]:
    """Return squared whitened residuals (k,), the weighted squares of everything else, and the depths (k,)."""
    observations = problem.observations
    xy, depth = project(
        problem.world_from_cam[observations.image],
        problem.points[observations.point],
        problem.intrinsics[problem.camera_of_image[observations.image]],
    )
    residual = np.einsum("kij,kj->ki", whiten, observations.xy_px - xy)
    extra = 0.0
    control, bars = problem.active_control, problem.active_bars
    if control is not None:
        weighted = ~control.exact
        offset = control.xyz[weighted] - problem.points[control.point[weighted]]
        extra += float(((offset / control.sigma[weighted]) ** 2).sum())
    if bars is not None:
        distance = np.linalg.norm(problem.points[bars.a] - problem.points[bars.b], axis=1)
        weighted = bars.sigma > 0
        extra += float((((bars.length - distance)[weighted] / bars.sigma[weighted]) ** 2).sum())
    if problem.active_priors is not None:
        extra += float((_pose_priors(problem)[0] ** 2).sum())
    return np.asarray((residual**2).sum(axis=1)), extra, depth


def moved(problem: BundleProblem, layout: Layout, step: Floats, point_step: Floats) -> BundleProblem:
    """Return the problem with its approximations moved by camera-side (W,) and point (m, 3) steps."""
    poses, points, intrinsics = problem.world_from_cam.copy(), problem.points + point_step, problem.intrinsics.copy()
    xi = step[: 6 * layout.images].reshape(-1, 6)
    poses[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :3], xi[:, 3:])
    poses[:, :3, :3] = poses[:, :3, :3] @ exp_rotation(xi[:, :3])
    for index, matrix in enumerate(layout.parameters):
        start = int(layout.parameter_start[index])
        intrinsics[index] += matrix @ step[start : start + matrix.shape[1]]
    points[layout.kept] += step[int(layout.parameter_start[-1]) :].reshape(-1, 3)
    return replace(problem, world_from_cam=poses, points=points, intrinsics=intrinsics)


def robust_weights(squared: Floats) -> Floats:
    """Return Cauchy weights (k,) of squared whitened residuals (k,)."""
    return 1.0 / (1.0 + squared / CAUCHY**2)


def _total(squared: Floats, extra: float, robust: bool) -> float:
    if robust:
        return float(CAUCHY**2 * np.log1p(squared / CAUCHY**2).sum()) + extra
    return float(squared.sum()) + extra


def solve(problem: BundleProblem, robust: bool = False, progress: Iterations = unseen) -> Solution:
    """Return the least-squares (or Cauchy) solution.

    Args:
        progress: told the iteration and the cost before each one.

    Raises:
        InfeasibleError: the iteration does not converge.
    """
    layout = problem.layout()
    whiten = whitener(problem.observations.covariance)
    squared, extra, _ = cost_parts(problem, whiten)
    cost, damping, raise_by, decrement = _total(squared, extra, robust), FIRST_DAMPING, 4.0, np.inf
    polished, linearised, rows = 0, None, np.zeros((0, layout.width + 1))
    for iteration in range(1, MOST_ITERATIONS + 1):
        progress(iteration, cost)
        if linearised is None:
            weights = np.sqrt(robust_weights(squared)) if robust else np.ones(len(squared))
            linearised, rows = equations(problem, layout, whiten * weights[:, None, None])
        step, point_step, decrement = _step(problem, layout, linearised, rows, damping)
        candidate = moved(problem, layout, step, point_step)
        new_squared, new_extra, depth = cost_parts(candidate, whiten)
        new_cost = _total(new_squared, new_extra, robust)
        misclosed = len(rows) > 0 and np.abs(rows[:, -1]).max() > 1e-12
        if decrement < CLOSE and not misclosed:
            # So close the change of the cost drowns in rounding: plain Gauss-Newton steps, judged by their length.
            if damping > 0.0:
                damping = 0.0  # a damped step may be short far from the minimum: look again
                continue
            problem, squared, cost, extra, linearised = candidate, new_squared, new_cost, new_extra, None
            polished += 1
            if decrement < STEP * (1e3 if robust else 1.0) or polished >= 10:
                return solution_at(problem, iteration)
        elif (depth > 0).all() and (new_cost <= cost or misclosed):
            # H. B. Nielsen's rule: the damping falls as far as the linear model keeps its promise.
            gain = 1.0 if misclosed else (cost - new_cost) / max(decrement**2, 1e-300)
            damping *= max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3) if gain < 1.0 else 0.1
            damping, raise_by = damping if damping > 1e-12 else 0.0, 4.0
            # Reweighting converges but linearly, and in a weak network hardly at all; it is a start, not an estimate.
            settled = robust and decrement < SETTLED and cost - new_cost < max(HARDLY[0], HARDLY[1] * cost)
            problem, squared, cost, extra, linearised = candidate, new_squared, new_cost, new_extra, None
            if settled and not misclosed:
                return solution_at(problem, iteration)
        else:
            damping, raise_by = max(damping, 1e-10) * raise_by, 2.0 * raise_by
        if damping > 1e12:
            break
    raise InfeasibleError(
        f"the adjustment does not converge ({iteration} iterations, last step {decrement:.1e} standard deviations): "
        "approximate values too far off, gross errors (try --robust), or a network that does not hold together"
    )


def solution_at(problem: BundleProblem, iterations: int) -> Solution:
    """Return the solution whose minimum is where the problem's approximations are, found by another solver."""
    layout, whiten = problem.layout(), whitener(problem.observations.covariance)
    squared, extra, _ = cost_parts(problem, whiten)
    linearised, rows = equations(problem, layout, whiten)
    return Solution(
        problem=problem,
        linearised=linearised,
        constraints=rows[:, :-1],
        cost=float(squared.sum()) + extra,
        iterations=iterations,
    )


def newton_decrement(problem: BundleProblem) -> float:
    """Return how far the least-squares minimum is from the approximations, in standard deviations of all unknowns."""
    layout = problem.layout()
    linearised, rows = equations(problem, layout, whitener(problem.observations.covariance))
    return _step(problem, layout, linearised, rows, 0.0)[2]


def equations(problem: BundleProblem, layout: Layout, whiten: Floats) -> tuple[Linearised, Floats]:
    """Return the observation equations of everything measured, and the rows [H | misclosure] of error-free bars."""
    linearised, _ = linearise(
        problem.observations, layout, problem.world_from_cam, problem.points, problem.intrinsics, whiten
    )
    return _extra_equations(problem, layout, linearised)


def _step(
    problem: BundleProblem, layout: Layout, linearised: Linearised, rows: Floats, damping: float
) -> tuple[Floats, Floats, float]:
    """Return the damped step of the camera side (W,) and the points (m, 3), and its length in standard deviations."""
    reduced = reduce_normals(linearised, damping)
    gauge, _ = null_space(problem, layout)
    scale = 1.0 / np.sqrt(np.where(reduced.diagonal > 0, reduced.diagonal, 1.0))
    matrix = reduced.schur * scale[:, None] * scale[None, :]
    if gauge.shape[1]:
        basis = np.linalg.qr(gauge / scale[:, None])[0]
        matrix = matrix + basis @ basis.T
    right = reduced.camera_rhs * scale
    if len(rows):
        border = rows[:, :-1] * scale[None, :]
        count = len(rows)
        matrix = np.block([[matrix, border.T], [border, np.zeros((count, count))]])
        step = np.linalg.lstsq(matrix, np.r_[right, rows[:, -1]], rcond=1e-14)[0][: len(scale)]
    else:
        try:
            step = cho_solve(cho_factor(matrix, lower=True), right)
        except LinAlgError:
            step = np.linalg.lstsq(matrix, right, rcond=1e-13)[0]
    step = step * scale
    coupled = reduced.coupling.times(step)
    direct = np.einsum("mij,mj->mi", reduced.inverse, reduced.point_rhs)
    # Newton decrement: rhsᵀ N⁻¹ rhs of the whole system, points and camera side.
    decrement = float(reduced.camera_rhs @ step + (reduced.point_rhs * direct).sum())
    return step, direct - coupled, float(np.sqrt(max(decrement, 0.0)))
