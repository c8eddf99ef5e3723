"""Predicted against achieved accuracy of one network, one realisation, without any assumption of independent points.

d = estimate - truth after a similarity over the estimated points (7 parameters), Σ the joint covariance predicted from
the observations that were used (P2), M the points' normal matrix reduced for everything else, nu = 3m - 7:

    T    = dᵀ M d             chi² (nu)        the whole covariance, correlations and the a-priori sigma included
    s0²  = vᵀ P v / r         chi² (r)/r       the noise of the image points
    F    = (T/nu) / s0²       F (nu, r)        the geometry alone: the a-priori sigma cancels
                                               (scaled, with fewer degrees of freedom, where image points correlate)
    rho  = sqrt(dᵀd / tr Σ)   weighted chi²    the number a user understands
    coverage, NEES            sampled from N(0, Σ)

T, F and rho decide, each in its own interval; a bare "within 10 %" decides nothing. One network alone cannot confirm a
prediction to 10 %: see ``campaign``.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2

from netdesign.adjustment.statistics import (
    SumsOfSquares,
    chi2_interval,
    f_interval,
    log_rms_moments,
    rms_interval,
    sampled_interval,
)
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Adjustment, Interval, Validation
from netdesign.model.arrays import Floats
from netdesign.model.frames import similarity
from netdesign.model.results import PointPrecision
from netdesign.photogrammetry.normals import Linearised
from netdesign.photogrammetry.observation_equations import Layout, linearise, parameter_matrix, whitener

LEVEL = 0.99
DRAWS = 2000


def compare(
    truth: Floats,
    adjustment: Adjustment,
    limited: PointPrecision,
    total: PointPrecision,
    level: float = LEVEL,
    seed: int = 0,
    joint_covariance: Floats | None = None,
    sums: SumsOfSquares | None = None,
) -> Validation:
    """Return the verdict on one network.

    Args:
        truth: (m, 3) m, true object points.
        adjustment: free datum, with its joint covariance (``bundle.adjust``).
        limited, total: predictions at design (P0, P1), for the same m points.
        level: of the intervals.  seed: of the draws for coverage and NEES.
        joint_covariance: Σ (3m, 3m) m² where it is not the adjustment's own, as when image points are correlated
            (``correlated``).  sums: what T and vᵀPv are expected to be then.

    Raises:
        InfeasibleError: fewer than four points have an estimate, or the network has no redundancy.
    """
    used = adjustment.used
    count = int(used.sum())
    if adjustment.joint_covariance is None:
        raise ValueError("adjustment: expected one with its joint covariance")
    if count < 4 or adjustment.redundancy < 1:
        raise InfeasibleError(
            f"comparison: expected at least 4 points with an estimate and redundancy 1, found {count} and "
            f"{adjustment.redundancy}"
        )
    scale, rotation, translation = similarity(adjustment.points[used], truth[used])
    aligned = scale * adjustment.points[used] @ rotation.T + translation
    # Back to the adjustment's own axes and unit, in which its covariance is expressed.
    error = (aligned - truth[used]) @ rotation / scale
    rows = np.repeat(used, 3)
    whole = adjustment.joint_covariance if joint_covariance is None else joint_covariance
    joint = whole[np.ix_(rows, rows)]
    values, vectors = np.linalg.eigh(joint)
    values = np.maximum(values, 0.0)
    nu, r = 3 * count - 7, adjustment.redundancy
    t_sum = _quadratic_form(adjustment, error)
    s0_squared = adjustment.sigma0**2
    nees, inside, nees_draws, inside_draws = _ellipsoids(error, joint, values, vectors, seed)
    expected = sums or SumsOfSquares.independent(nu, r)
    t_mean, s0_mean = expected.t_mean / nu, expected.v_mean / r
    t = chi2_interval(t_sum / nu, expected.t_dof, level, t_mean)
    s0 = chi2_interval(s0_squared, expected.v_dof, level, s0_mean)
    ratio = f_interval(t_sum / nu / s0_squared, *expected.ratio_dofs, level, t_mean / s0_mean)
    rho = rms_interval(float(np.sqrt((error**2).sum() / values.sum())), values, level)
    errors = np.full((len(used), 3), np.nan)
    errors[used] = aligned - truth[used]
    log_mean, log_sd = log_rms_moments(values)
    reasons = _reasons(t, s0, ratio, rho, count)
    return Validation(
        errors=errors,
        predicted={
            "limited": float(np.sqrt(limited.mean_variance)),
            "total": float(np.sqrt(total.mean_variance)),
            "used": float(np.sqrt(values.sum() / (3 * count))),
        },
        achieved_rms=float(np.sqrt((error**2).mean())),
        t=t,
        s0_squared=s0,
        f=ratio,
        rho=rho,
        coverage=sampled_interval(inside, inside_draws, level),
        nees=sampled_interval(nees, nees_draws, level),
        sums={"t": t_sum, "nu": float(nu), "vpv": s0_squared * r, "r": float(r), **expected.moments},
        nu_eff=float(values.sum() ** 2 / (values**2).sum()),
        log_rho_mean=log_mean,
        log_rho_sd=log_sd,
        level=level,
        passed=not reasons,
        datum=adjustment.datum,
        points_used=count,
        reasons=reasons,
        warnings=adjustment.warnings,
    )


def point_equations(adjustment: Adjustment) -> Linearised:
    """Return the observation equations of an adjustment at its estimates."""
    layout = Layout(
        images=len(adjustment.world_from_cam),
        camera_of_image=adjustment.camera_of_image,
        parameters=tuple(parameter_matrix(adjustment.parameter_names, row) for row in adjustment.intrinsics),
        kept=np.zeros(len(adjustment.points), dtype=np.bool_),
        eliminated=adjustment.used,
    )
    linearised, _ = linearise(
        adjustment.observations,
        layout,
        adjustment.world_from_cam,
        adjustment.points,
        adjustment.intrinsics,
        whitener(adjustment.observations.covariance),
    )
    return linearised


def _quadratic_form(adjustment: Adjustment, error: Floats) -> float:
    """Return T = dᵀ M d for errors (used, 3), M = N_pp - N_pc N_cc⁻¹ N_cp, without forming M.

    Gauge invariant: M vanishes on translations, rotations and scale.
    """
    linearised = point_equations(adjustment)
    full = np.zeros((len(adjustment.points), 3))
    full[adjustment.used] = error
    effect = np.einsum("kri,ki->kr", linearised.point_part, full[linearised.point])
    width = linearised.width
    normal, right = np.zeros((width, width)), np.zeros(width)
    valid = linearised.columns >= 0
    columns = np.where(valid, linearised.columns, 0)
    camera = np.where(valid[:, None, :], linearised.camera, 0.0)
    blocks = np.einsum("kra,krb->kab", camera, camera)
    np.add.at(normal, (columns[:, :, None], columns[:, None, :]), blocks)
    np.add.at(right, columns, np.einsum("kra,kr->ka", camera, effect))
    scale = 1.0 / np.sqrt(np.diag(normal))
    factor = cho_factor(normal * scale[:, None] * scale[None, :], lower=True)
    return float((effect**2).sum() - (scale * right) @ cho_solve(factor, scale * right))


def _ellipsoids(
    error: Floats, joint: Floats, values: Floats, vectors: Floats, seed: int
) -> tuple[float, float, Floats, Floats]:
    """Return mean NEES/3 and the share of points inside their 95 % ellipsoid, and both for draws from N(0, Σ)."""
    count = len(error)
    index = np.arange(count)
    weight = np.linalg.inv(joint.reshape(count, 3, count, 3)[index, :, index, :])
    limit = float(chi2.ppf(0.95, 3))
    draws = np.random.default_rng(seed).standard_normal((DRAWS, 3 * count)) * np.sqrt(values) @ vectors.T
    sampled = np.einsum("smi,mij,smj->sm", draws.reshape(DRAWS, count, 3), weight, draws.reshape(DRAWS, count, 3))
    actual = np.einsum("mi,mij,mj->m", error, weight, error)
    return (
        float(actual.mean() / 3.0),
        float((actual <= limit).mean()),
        sampled.mean(axis=1) / 3.0,
        (sampled <= limit).mean(axis=1),
    )


def _reasons(t: Interval, s0: Interval, f: Interval, rho: Interval, count: int) -> tuple[str, ...]:
    """Return why a network fails, and what the pattern of the statistics says about the cause."""
    reasons = []
    for name, interval in (("T/nu", t), ("F", f), ("rho", rho)):
        if not interval.inside:
            side = "above" if interval.value > interval.high else "below"
            reasons.append(f"{name} {interval.value:.3f} is {side} [{interval.low:.3f}, {interval.high:.3f}]")
    if not reasons:
        return ()
    if f.inside and not s0.inside:
        factor = np.sqrt(s0.value)
        reasons.append(
            f"F is inside while s0² {s0.value:.3f} is not: the image points are {factor:.2f} times as noisy as "
            "assumed, the geometry is right"
        )
    elif not f.inside and s0.value < s0.low:
        reasons.append(
            f"F is outside and s0² {s0.value:.3f} is low: image errors that are correlated or systematic, "
            "the residuals do not show them"
        )
    elif not f.inside:
        reasons.append(f"F is outside: the errors of the {count} points do not follow from the residuals; model error")
    return tuple(reasons)
