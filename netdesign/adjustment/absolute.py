"""Uncertainty in the robot's frame: what a robot's repeatability, as pose priors, leaves of position, turn and scale.

The free adjustment says how well the shape is known; where the part stands in the robot's frame is known only as well
as the poses are. The poses of the program are the priors, independent from image to image, their sigma the
repeatability; no similarity is taken out before the comparison. (A wrong hand-eye calibration is common to all poses
and in none of these numbers.) The error of the frame has few degrees of freedom: the interval of achieved over
predicted is wide, and exact as in ``statistics``.
"""

from dataclasses import dataclass, replace

import numpy as np

from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.problem import BundleProblem
from netdesign.adjustment.statistics import rms_interval
from netdesign.model.adjustment import Adjustment, Interval, PosePriors
from netdesign.model.arrays import Bools, Floats
from netdesign.model.network import Observations
from netdesign.photogrammetry.collinearity import project


@dataclass(frozen=True, kw_only=True)
class Absolute:
    """Predicted against achieved uncertainty in the robot's frame.

    Attributes:
        predicted_rms: m, from the observations that were used.  achieved_rms: m.
        rho: achieved over predicted, with its interval.  errors: (m, 3) m, NaN without estimate.
        sigma: (m, 3) m, predicted.
    """

    predicted_rms: float
    achieved_rms: float
    rho: Interval
    errors: Floats
    sigma: Floats


def repeatability_priors(repeatability: tuple[float, float], world_from_cam: Floats) -> PosePriors | None:
    """Return the poses of a program (n, 4, 4) as priors, None for a robot without stated repeatability.

    Args:
        repeatability: sigma per axis of position in m and rotation in rad; 0: not known.
    """
    if max(repeatability) <= 0:
        return None
    position, rotation = (sigma if sigma > 0 else np.inf for sigma in repeatability)
    return PosePriors(world_from_cam=world_from_cam, sigma_position=position, sigma_rotation=rotation)


def absolute_comparison(truth: Floats, problem: BundleProblem, priors: PosePriors, level: float) -> Absolute:
    """Return predicted and achieved uncertainty of a network whose poses are known to the priors.

    Args:
        truth: (m, 3) m in the frame of the priors.  problem: without gross errors.  level: of the interval.

    Raises:
        InfeasibleError: the priors and the image points do not determine the network.
    """
    adjustment = _adjusted(problem, priors)
    used = adjustment.used
    errors = np.full((len(truth), 3), np.nan)
    errors[used] = adjustment.points[used] - truth[used]
    rows = np.repeat(used, 3)
    assert adjustment.joint_covariance is not None
    values = np.maximum(np.linalg.eigvalsh(adjustment.joint_covariance[np.ix_(rows, rows)]), 0.0)
    square, trace = float((errors[used] ** 2).sum()), float(values.sum())
    sigma = np.sqrt(np.einsum("mii->mi", adjustment.point_covariance))
    return Absolute(
        predicted_rms=float(np.sqrt(trace / (3 * used.sum()))),
        achieved_rms=float(np.sqrt(square / (3 * used.sum()))),
        rho=rms_interval(float(np.sqrt(square / trace)), values, level),
        errors=errors,
        sigma=np.where(used[:, None], sigma, np.inf),
    )


def absolute_prediction(points: Floats, priors: PosePriors, intrinsics: Floats, visible: Bools, sigma: Floats) -> float:
    """Return the rms uncertainty in m in the robot's frame that a design promises.

    Args:
        points: (m, 3) m.  priors: at the planned poses.  intrinsics: (8,).  visible: (n, m).
        sigma: (n, m) px of a coordinate of a sighting.

    Raises:
        InfeasibleError: the priors and the image points do not determine the network.
    """
    poses = priors.world_from_cam
    image, point = np.nonzero(visible)
    xy_px, _ = project(poses[image], points[point], intrinsics)
    covariance = sigma[image, point, None, None] ** 2 * np.eye(2)
    problem = BundleProblem(
        observations=Observations(image=image, point=point, xy_px=xy_px, covariance=covariance),
        camera_of_image=np.zeros(len(poses), dtype=np.int64),
        intrinsics=intrinsics[None],
        world_from_cam=poses,
        points=points,
        image_names=[str(i) for i in range(len(poses))],
        point_names=[str(j) for j in range(len(points))],
    )
    adjustment = _adjusted(problem, priors)
    return float(np.sqrt(np.einsum("mii->m", adjustment.point_covariance[adjustment.used]).mean() / 3.0))


def _adjusted(problem: BundleProblem, priors: PosePriors) -> Adjustment:
    return estimate(replace(problem, datum="poses", priors=priors), joint=True)
