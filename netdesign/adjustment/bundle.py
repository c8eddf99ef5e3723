"""Bundle adjustment by GTSAM: C++ factors, joint marginals of all points, carried to the free datum.

The only file that imports gtsam. What is GTSAM's own way and is converted or guarded here:

* Pose3 is world_from_cam, its tangent (omega, v) in the camera frame: ours. Cal3DS2 carries a skew, held by a prior.
* The gauge is held by exactly seven constraints (the pose of one camera and the distance to the farthest other one);
  with exactly seven the joint covariance, once carried to the inner-constraint datum, does not depend on their sigma.
* Levenberg-Marquardt reports success on degenerate networks, NaN and points behind the camera: all are looked for
  before and after. ``Marginals`` throws on an indeterminate system: caught, and told as such.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import K, L, X

from netdesign.adjustment.appraisal import anchored, appraise
from netdesign.adjustment.problem import BundleProblem, check_input, check_start, null_space
from netdesign.adjustment.solver import newton_decrement, solution_at
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Bools, Floats
from netdesign.model.camera import Camera
from netdesign.model.network import Observations
from netdesign.photogrammetry.datum import blocks, s_transformation

GAUGE_SIGMA = 1e-4  # rad, and units of the object's extent
FREE_SIGMA = 1e6
HELD_SIGMA_PX = 1e-5
HELD_SIGMA_DISTORTION = 1e-5 / 36
CONVERGED = 1e-3  # standard deviations of all unknowns together
AGREEMENT = 1e-4  # of GTSAM's and our joint covariance: a larger difference is a defect, not rounding


def adjust(
    observations: Observations,
    camera: Camera,
    world_from_cam: Floats,
    points: Floats,
    refine: tuple[str, ...] = (),
    datum_points: Bools | None = None,
    image_names: Sequence[str] | None = None,
    point_names: Sequence[str] | None = None,
) -> Adjustment:
    """Adjust a free network: inner constraints over the observed points, anchored on their approximate values.

    Args:
        observations: image points with their covariances.  camera: start (or fixed) interior orientation.
        world_from_cam: (n, 4, 4) m and points: (m, 3) m, approximate values. Unobserved points get no estimate.
        refine: interior parameters to estimate, of fx, fy, cx, cy, k1, k2, p1, p2 (GTSAM cannot tie fx to fy).

    Raises:
        InputError: values that are no numbers, an image point given twice.
        InfeasibleError: the network is not determined; the message names the images and points.
    """
    if "f" in refine:
        raise ValueError("refine: Cal3DS2 cannot tie fx to fy; use adjustment.estimate")
    problem = BundleProblem(
        observations=observations,
        camera_of_image=np.zeros(len(world_from_cam), dtype=np.int64),
        intrinsics=camera.intrinsics[None, :],
        world_from_cam=np.asarray(world_from_cam, dtype=np.float64),
        points=np.asarray(points, dtype=np.float64),
        image_names=[str(i) for i in range(len(world_from_cam))] if image_names is None else image_names,
        point_names=[str(j) for j in range(len(points))] if point_names is None else point_names,
        refine=refine,
        datum_points=datum_points,
    )
    check_input(problem)
    scaled, unit, centre = problem.normalised()
    check_start(scaled)
    result, iterations = _optimise(*_graph(scaled))
    solved = _estimates(scaled, result)
    try:
        check_start(solved)  # a point behind its camera: GTSAM's factors go silent there
    except InfeasibleError as error:
        raise InfeasibleError(f"the adjustment does not converge: {error}") from None
    remaining = newton_decrement(solved)
    if remaining > CONVERGED:
        raise InfeasibleError(
            f"GTSAM's adjustment does not converge ({iterations} iterations; the minimum is still {remaining:.1e} "
            "standard deviations away): approximate values too far off, gross errors, or a network that does not hold "
            "together"
        )
    solution = anchored(solution_at(solved, iterations), scaled.points)
    adjustment = appraise(solution, unit, centre, False, (), ())
    joint = joint_marginals(solution.problem, adjustment.used) * unit**2
    covariance = np.full_like(adjustment.point_covariance, np.inf)
    covariance[adjustment.used] = blocks(joint)[adjustment.used]
    difference = np.linalg.norm(covariance[adjustment.used] - adjustment.point_covariance[adjustment.used])
    if not difference <= AGREEMENT * np.linalg.norm(adjustment.point_covariance[adjustment.used]):
        raise InfeasibleError(
            "the joint marginals of GTSAM and the reduced normal equations disagree: the network is close to singular "
            f"(lambda8 {adjustment.lambda8:.1e})"
        )
    return replace(adjustment, joint_covariance=joint, point_covariance=covariance)


def _graph(problem: BundleProblem) -> tuple[Any, Any]:
    """Return the factor graph with its gauge and the values at the problem's approximations; unit lengths."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    observations = problem.observations
    calibration = gtsam.Cal3DS2(*_cal3ds2(problem.intrinsics[0]))
    for i, pose in enumerate(problem.world_from_cam):
        values.insert(X(i), gtsam.Pose3(pose))
    for j in np.unique(observations.point).tolist():
        values.insert(L(j), problem.points[j])
    if problem.refine:
        values.insert(K(0), calibration)
        names = ("fx", "fy", "skew", "cx", "cy", "k1", "k2", "p1", "p2")
        held = {"k1": HELD_SIGMA_DISTORTION, "k2": HELD_SIGMA_DISTORTION, "p1": HELD_SIGMA_DISTORTION,
                "p2": HELD_SIGMA_DISTORTION}  # fmt: skip
        sigmas = [FREE_SIGMA if name in problem.refine else held.get(name, HELD_SIGMA_PX) for name in names]
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))
        graph.add(gtsam.PriorFactorCal3DS2(K(0), calibration, noise))
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    for xy, covariance, i, j in zip(
        observations.xy_px,
        observations.covariance,
        observations.image.tolist(),
        observations.point.tolist(),
        strict=True,
    ):
        if problem.refine:
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(xy, gaussian(covariance), X(i), L(j), K(0)))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3DS2(xy, gaussian(covariance), X(i), L(j), calibration))
    _add_datum(graph, problem)
    return graph, values


def _add_datum(graph: Any, problem: BundleProblem) -> None:
    """Add weighted control and scale bars, and a gauge of exactly as many constraints as stay open."""
    isotropic = gtsam.noiseModel.Isotropic.Sigma
    control, bars = problem.active_control, problem.active_bars
    if control is not None:
        for j, xyz, sigma in zip(control.point.tolist(), control.xyz, control.sigma, strict=True):
            graph.add(gtsam.PriorFactorPoint3(L(j), xyz, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    if bars is not None:
        for a, b, length, sigma in zip(
            bars.a.tolist(), bars.b.tolist(), bars.length.tolist(), bars.sigma.tolist(), strict=True
        ):
            graph.add(gtsam.RangeFactor3(L(a), L(b), length, isotropic(1, sigma)))
    open_ = null_space(problem, problem.layout())[0].shape[1]
    if open_ >= 6:
        graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(problem.world_from_cam[0]), isotropic(6, GAUGE_SIGMA)))
    if open_ == 7:
        position = problem.world_from_cam[:, :3, 3]
        distance = np.linalg.norm(position - position[0], axis=1)
        far = int(np.argmax(distance))
        graph.add(gtsam.RangeFactorPose3(X(0), X(far), float(distance[far]), isotropic(1, GAUGE_SIGMA)))


def _cal3ds2(intrinsics: Floats) -> list[float]:
    fx, fy, cx, cy, k1, k2, p1, p2 = intrinsics.tolist()
    return [fx, fy, 0.0, cx, cy, k1, k2, p1, p2]


def _optimise(graph: Any, values: Any) -> tuple[Any, int]:
    """Return the optimum and the iterations it took.

    Raises:
        InfeasibleError: the error grew.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    parameters.setMaxIterations(100)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    start = graph.error(values)
    result = optimiser.optimize()
    iterations = int(optimiser.iterations())
    error = graph.error(result)
    if not np.isfinite(error) or error > start:
        raise InfeasibleError(f"GTSAM's adjustment diverges: error {start:.3g} at the start, {error:.3g} at the end")
    return result, iterations


def _estimates(problem: BundleProblem, result: Any) -> BundleProblem:
    """Return the problem with GTSAM's estimates in place of the approximations."""
    poses = np.array([result.atPose3(X(i)).matrix() for i in range(len(problem.world_from_cam))])
    points = problem.points.copy()
    for j in np.unique(problem.observations.point).tolist():
        points[j] = result.atPoint3(L(j))
    intrinsics = problem.intrinsics
    if problem.refine:
        vector = result.atCal3DS2(K(0)).vector()
        intrinsics = np.asarray(vector)[[0, 1, 3, 4, 5, 6, 7, 8]][None, :]
    return replace(problem, world_from_cam=poses, points=points, intrinsics=intrinsics)


def joint_marginals(problem: BundleProblem, used: Bools) -> Floats:
    """Return GTSAM's joint covariance (3m, 3m) of the points in the problem's datum, inf for unused points.

    Args:
        problem: at its minimum, lengths in units of the object's extent. Control must be weighted, not error-free
            (GTSAM's marginals do not take hard constraints), and so must scale bars.
        used: (m,) points that have an estimate.

    Raises:
        InfeasibleError: GTSAM finds the system indeterminate.
    """
    graph, values = _graph(problem)
    index = np.flatnonzero(used)
    keys = [L(j) for j in index.tolist()]  # ascending: the order of the answer whatever the version
    try:
        marginal = gtsam.Marginals(graph, values).jointMarginalCovariance(keys).fullMatrix()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise InfeasibleError(f"GTSAM finds the network indeterminate: {reason}") from None
    datum = None if problem.datum_points is None else problem.datum_points[index]
    open_ = null_space(problem, problem.layout())[0].shape[1]
    covariance = np.asarray(marginal)
    if open_ >= 6:
        covariance = s_transformation(covariance, problem.points[index], datum, open_)
    count = len(used)
    joint = np.zeros((3 * count, 3 * count))
    rows = (3 * index[:, None] + np.arange(3)).ravel()
    joint[np.ix_(rows, rows)] = covariance
    unused = np.repeat(~used, 3)
    joint[unused, unused] = np.inf
    return joint
