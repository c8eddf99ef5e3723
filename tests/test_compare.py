import numpy as np
import pytest
from scipy.special import digamma, polygamma
from scipy.stats import chi2, kstest

from netdesign.adjustment.bundle import adjust
from netdesign.adjustment.compare import compare
from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.statistics import WeightedChi2, log_rms_moments, rms_interval
from netdesign.errors import InfeasibleError
from netdesign.model.results import PointPrecision
from netdesign.photogrammetry.total_error import total_covariance
from tests.bundle_cases import INTRINSICS, camera_of, observe, problem_of, random_visibility, relief


def _predictions(poses, points, visible, sigma=0.1):
    total = total_covariance(poses, points, INTRINSICS, visible, sigma)
    limited = PointPrecision(covariance=total.limited, rays=total.rays, propagation="limited", datum="camera")
    return limited, total.precision


def test_weighted_chi2_reduces_to_chi2_and_agrees_with_sampling():
    for dof in (6, 65, 600):
        equal = WeightedChi2.of(np.full(dof, 3.7))
        for x in (0.3, 0.9, 1.0, 1.2, 2.5):
            assert equal.cdf(x) == pytest.approx(chi2.cdf(dof * x, dof), abs=1e-11)
    weights = np.r_[np.geomspace(1, 1e-3, 80), np.zeros(7)]
    distribution = WeightedChi2.of(weights)
    draws = np.random.default_rng(0).standard_normal((200_000, 87)) ** 2 @ (weights / weights.sum())
    for p in (0.005, 0.025, 0.5, 0.975, 0.995):
        # The standard error of an empirical distribution function at p; four of them.
        assert (draws <= distribution.ppf(p)).mean() == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / 200_000))
    interval = rms_interval(1.0, weights, 0.95)
    assert interval.low < 1 < interval.high
    assert interval.inside


def test_moments_of_log_rho_are_those_of_chi2_and_of_samples():
    for dof in (1, 2, 5, 65, 900):
        mean, sd = log_rms_moments(np.full(dof, 0.2))
        assert mean == pytest.approx(0.5 * (digamma(dof / 2) + np.log(2 / dof)), abs=1e-9)
        assert sd == pytest.approx(0.5 * np.sqrt(polygamma(1, dof / 2)), rel=1e-7)
    weights = np.r_[1.0, 0.6, np.geomspace(0.1, 1e-5, 80), np.zeros(7)]
    draws = np.random.default_rng(0).standard_normal((200_000, len(weights))) ** 2 @ (weights / weights.sum())
    mean, sd = log_rms_moments(weights)
    assert mean < -0.05  # weak: a right prediction has log rho well below 0
    assert 0.5 * np.log(draws).mean() == pytest.approx(mean, abs=4 * sd / np.sqrt(200_000))
    assert 0.5 * np.log(draws).std() == pytest.approx(sd, rel=4 / np.sqrt(2 * 200_000))


def test_quadratic_form_equals_the_dense_matrix_and_ignores_the_gauge():
    poses, points = relief(5, 20, seed=1)
    visible = random_visibility(5, 20, 0.8)
    result = adjust(observe(poses, points, visible, seed=3), camera_of(), poses, points)
    validation = compare(points, result, *_predictions(poses, points, visible))
    error = validation.errors.ravel()
    values, vectors = np.linalg.eigh(result.joint_covariance)
    keep = values > 1e-8 * values[-1]
    assert keep.sum() == 3 * 20 - 7
    dense = float((((vectors[:, keep].T @ error) ** 2) / values[keep]).sum())
    assert validation.sums["t"] == pytest.approx(dense, rel=1e-3)  # to second order of the alignment
    moved = compare(1.02 * points @ np.diag([1.0, -1, -1]) + 0.3, result, *_predictions(poses, points, visible))
    assert moved.sums["t"] == pytest.approx(validation.sums["t"], rel=1e-9)
    assert moved.rho.value == pytest.approx(validation.rho.value, rel=1e-9)


def test_right_predictions_pass_and_wrong_ones_say_why():
    poses, points = relief(10, 100, seed=2)
    visible = random_visibility(10, 100, 0.6)
    predictions = _predictions(poses, points, visible)
    result = adjust(observe(poses, points, visible, seed=1), camera_of(), poses, points)
    good = compare(points, result, *predictions)
    assert good.passed, good.reasons
    assert good.predicted["used"] == pytest.approx(good.predicted["total"], rel=1e-3)
    assert good.nu_eff < good.sums["nu"]
    rng = np.random.default_rng(0)
    observations = observe(poses, points, visible, noise=False)
    noisy = observations.xy_px + 0.15 * rng.standard_normal(observations.xy_px.shape)
    louder = type(observations)(
        image=observations.image, point=observations.point, xy_px=noisy, covariance=observations.covariance
    )
    wrong_sigma = compare(points, adjust(louder, camera_of(), poses, points), *predictions)
    assert not wrong_sigma.passed
    assert wrong_sigma.f.inside
    assert "as noisy as assumed" in " ".join(wrong_sigma.reasons)
    bent = compare(points * [1, 1, 1.002], result, *predictions)
    assert not bent.f.inside
    assert "F is outside" in " ".join(bent.reasons)


def test_too_little_to_compare_is_said():
    poses, points = relief(4, 12, seed=3)
    result = estimate(problem_of(observe(poses, points, np.ones((4, 12), bool)), poses, points))
    with pytest.raises(ValueError, match="joint covariance"):
        compare(points, result, *_predictions(poses, points, np.ones((4, 12), bool)))
    visible = np.zeros((2, 5), bool)
    visible[:] = True
    poses, points = relief(2, 5, seed=3)
    exact = estimate(problem_of(observe(poses, points, visible), poses, points), joint=True)
    assert exact.redundancy == 0
    assert np.isnan(exact.sigma0)
    with pytest.raises(InfeasibleError, match="found 5 and 0"):
        compare(points, exact, *_predictions(poses, points, visible))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("images", "count", "share", "sigma", "refine"),
    [
        (4, 28, 0.9, 0.1, ()),
        (6, 84, 0.6, 0.1, ()),
        (10, 100, 0.6, 0.1, ()),
        (4, 28, 0.9, 1.0, ()),
        (10, 60, 0.7, 0.1, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
        (10, 24, 0.35, 0.1, ()),
    ],
)
def test_monte_carlo(images, count, share, sigma, refine):
    """500 adjustments: the predicted trace is achieved, T and F are uniform, ellipsoids cover 95 %."""
    runs = 500
    poses, points = relief(images, count, seed=images + count)
    visible = random_visibility(images, count, share, seed=1)
    total = total_covariance(poses, points, INTRINSICS, visible, sigma, refine)
    limited = PointPrecision(covariance=total.limited, rays=total.rays, propagation="limited", datum="camera")
    assert total.determined
    results = []
    for seed in range(runs):
        observations = observe(poses, points, visible, sigma, seed=1000 + seed)
        result = estimate(problem_of(observations, poses, points, refine=refine), joint=True)
        results.append(compare(points, result, limited, total.precision))
    nu_eff = np.mean([r.nu_eff for r in results])
    ratio = np.mean([r.rho.value**2 for r in results])
    assert abs(ratio - 1) < 3 * np.sqrt(2 / (nu_eff * runs)), ratio
    assert kstest([r.t.pit for r in results], "uniform").pvalue > 1e-3
    assert kstest([r.f.pit for r in results], "uniform").pvalue > 1e-3
    assert kstest([r.rho.pit for r in results], "uniform").pvalue > 1e-3
    assert 0.93 < np.mean([r.coverage.value for r in results]) < 0.97
