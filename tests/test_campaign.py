import json
from dataclasses import replace

import numpy as np
import pytest

from netdesign.adjustment.bundle import adjust
from netdesign.adjustment.campaign import RHO_MARGIN, Band, Member, _realisations_needed, member_of, pool
from netdesign.adjustment.compare import compare
from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.lengths import chosen_lengths, length_test, length_uncertainty
from netdesign.adjustment.statistics import SumsOfSquares, log_rms_moments
from netdesign.errors import InfeasibleError
from netdesign.files.adjustment import campaign_member, campaign_payload, length_payload, validation_payload
from netdesign.files.store import plain
from netdesign.model.results import PointPrecision
from netdesign.photogrammetry.total_error import total_covariance
from tests.bundle_cases import INTRINSICS, camera_of, observe, problem_of, random_visibility, relief


def _validation(seed, factor=1.0, images=8, count=40):
    """One network, one realisation; the true noise is ``factor`` times the assumed one."""
    poses, points = relief(images, count, seed=seed)
    visible = random_visibility(images, count, 0.7, seed)
    total = total_covariance(poses, points, INTRINSICS, visible, 0.1)
    limited = PointPrecision(covariance=total.limited, rays=total.rays, propagation="limited", datum="camera")
    loud = observe(poses, points, visible, 0.1 * factor, seed=seed)
    observations = type(loud)(
        image=loud.image, point=loud.point, xy_px=loud.xy_px, covariance=loud.covariance / factor**2
    )
    result = estimate(problem_of(observations, poses, points), joint=True)
    return compare(points, result, limited, total.precision)


@pytest.fixture(scope="module")
def right():
    return [member_of(str(seed), _validation(seed)) for seed in range(24)]


def test_right_predictions_are_equivalent(right):
    campaign = pool(right)
    assert campaign.t.inside
    assert campaign.s0_squared.inside
    assert campaign.f.inside
    assert campaign.equivalent, campaign.statement
    assert min(campaign.ks.values()) > 1e-3
    assert campaign.rho.low < 1 < campaign.rho.high
    assert 0.92 < campaign.coverage < 0.98
    assert campaign.against["used"] == pytest.approx(campaign.rho.value)
    assert campaign.plain["used"] == pytest.approx(np.exp(np.mean(np.log([m.rho for m in right]))))
    assert "is shown to be" in campaign.statement


def test_a_wrong_sigma_shows_in_t_and_s0_and_not_in_f():
    campaign = pool([member_of(str(seed), _validation(seed, factor=1.15)) for seed in range(16)])
    assert not campaign.t.inside
    assert not campaign.s0_squared.inside
    assert campaign.f.inside
    assert not campaign.equivalent
    assert campaign.rho.value == pytest.approx(1.15, abs=0.06)
    assert "is not the achieved one" in campaign.statement


def _drawn(weights, count, seed, factor=1.0):
    """Members whose rho are drawn from their null distribution, times a factor."""
    random = np.random.default_rng(seed)
    mean, sd = log_rms_moments(weights)
    rho = factor * np.sqrt(random.standard_normal((count, len(weights))) ** 2 @ (weights / weights.sum()))
    return [
        Member(
            name=str(index), t_sum=60.0, nu=60, vpv=200.0, r=200, expected=SumsOfSquares.independent(60, 200),
            rho=value, log_rho_mean=mean, log_rho_sd=sd,
            coverage=0.95, points_used=20, pits={"t": 0.5, "s0_squared": 0.5, "f": 0.5, "rho": 0.5},
            predicted={"used": 2e-5}, achieved=2e-5 * value,
        )
        for index, value in enumerate(rho)
    ]  # fmt: skip


def test_weak_networks_pull_the_plain_mean_down_and_not_the_verdict():
    weak, strong = np.geomspace(1, 1e-12, 60) ** 2, np.ones(60)
    campaign = pool(_drawn(weak, 300, 1) + _drawn(strong, 100, 2))
    assert campaign.plain["expected"] < 0.9
    assert np.log(campaign.plain["used"] / campaign.plain["expected"]) == pytest.approx(0, abs=4 * campaign.plain["sd"])
    assert campaign.rho.low < 1 < campaign.rho.high
    # Weighted with their precision the strong networks count: 4 of their sd, about 0.04.
    assert campaign.rho.value == pytest.approx(1.0, abs=0.04)
    wrong = pool(_drawn(weak, 300, 1, factor=1.2) + _drawn(strong, 100, 2, factor=1.2))
    assert wrong.rho.value == pytest.approx(1.2 * campaign.rho.value)
    assert not wrong.equivalent


def test_one_network_proves_nothing(right):
    campaign = pool(right[:1])
    assert not campaign.rho.equivalent
    assert "is not shown to be the achieved one yet" in campaign.statement
    assert np.isnan(campaign.slope.value)
    with pytest.raises(InfeasibleError, match="nothing to pool"):
        pool([])


@pytest.mark.parametrize(("value", "half"), [(1.0, 0.5), (1.05, 0.2), (0.93, 0.31)])
def test_as_many_realisations_as_said_narrow_the_interval_enough(value, half):
    """The width of an interval falls with the root of the number: what is said fits, one less does not."""
    count = 5

    def band(number):
        reach = np.exp(half * np.sqrt(count / number))
        return Band(value=value, low=value / reach, high=value * reach, margin=RHO_MARGIN)

    needed = _realisations_needed(band(count), count)
    assert band(needed).equivalent
    assert not band(needed - 1).equivalent


def test_slope_is_one_over_networks_of_different_precision():
    members = [member_of(str(seed), _validation(seed, images=4 + seed, count=30)) for seed in range(12)]
    campaign = pool(members)
    assert campaign.slope.low < 1 < campaign.slope.high
    assert campaign.kendall > 0.3


def test_networks_with_correlated_image_points_are_pooled_with_what_is_expected_of_them():
    """Sums whose means and variances are not those of chi²: the pooled verdict knows, and without that it rejects."""
    random, count, t_mean, v_mean = np.random.default_rng(3), 120, 66.0, 190.0
    # Gamma variables with these means, the variances twice those of chi².
    t, v = random.gamma(t_mean / 4, 4.0, count), random.gamma(v_mean / 4, 4.0, count)
    expected = SumsOfSquares(t_mean=t_mean, t_variance=4 * t_mean, v_mean=v_mean, v_variance=4 * v_mean, common=0.0)
    plain_members = _drawn(np.ones(60), count, 4)
    known = [replace(m, t_sum=a, vpv=b, expected=expected) for m, a, b in zip(plain_members, t, v, strict=True)]
    ignored = [replace(m, t_sum=a, vpv=b) for m, a, b in zip(plain_members, t, v, strict=True)]
    right, wrong = pool(known), pool(ignored)
    assert right.t.inside
    assert right.s0_squared.inside
    assert right.f.inside
    assert right.root_f.low < 1 < right.root_f.high
    assert not wrong.t.inside
    assert not wrong.s0_squared.inside
    assert wrong.root_f.low > 1
    # Twice the variance: intervals wider by the root of two.
    width = (right.t.high - right.t.low) / (wrong.t.high - wrong.t.low)
    assert width == pytest.approx(np.sqrt(2) * np.sqrt(t_mean / 60), rel=0.03)


def test_repeats_split_bias_from_noise():
    rng = np.random.default_rng(0)
    bias = 1e-5 * rng.standard_normal((50, 3))
    members = []
    for _ in range(30):
        errors = bias + 2e-5 * rng.standard_normal((50, 3))
        members.append(
            Member(
                name="0", t_sum=143.0, nu=143, vpv=200.0, r=200, expected=SumsOfSquares.independent(143, 200),
                rho=1.0, log_rho_mean=-0.006, log_rho_sd=0.08,
                coverage=0.95, points_used=50,
                pits={"t": 0.5, "s0_squared": 0.5, "f": 0.5, "rho": 0.5}, predicted={"used": 2e-5}, achieved=2e-5,
                errors=errors,
            )
        )  # fmt: skip
    assert pool(members).repeats["0"].bias_share == pytest.approx(0.2, abs=0.03)


def test_the_file_gives_back_the_same_campaign(right):
    validation = _validation(3)
    record = json.loads(json.dumps(plain(validation_payload(validation, [f"{j}.0" for j in range(40)]))))
    again = campaign_member("3", record)
    direct = member_of("3", validation)
    assert again.t_sum == direct.t_sum
    assert again.pits == direct.pits
    assert again.expected == direct.expected
    np.testing.assert_allclose(again.errors, direct.errors, rtol=1e-12)
    json.dumps(plain(campaign_payload(pool([again, *right]))), allow_nan=False)


def test_length_errors_follow_their_prediction():
    poses, points = relief(10, 80, seed=2)
    visible = random_visibility(10, 80, 0.7)
    ratios, inside = [], []
    for seed in range(15):
        result = adjust(observe(poses, points, visible, seed=seed), camera_of(), poses, points)
        found = length_test(points, result)
        ratios.append(found.rms_ratio**2)
        inside.append(found.inside)
    assert len(found.line) == 35
    assert len(np.unique(found.line)) == 7
    assert found.longest_share > 0.6
    # 15 realisations of 35 lengths that share points: about 20 independent ones each.
    assert np.mean(ratios) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (15 * 20)))
    assert np.mean(inside) == pytest.approx(0.954, abs=0.04)
    json.dumps(plain(length_payload(found, [str(j) for j in range(80)])), allow_nan=False)


def test_length_uncertainty_uses_the_correlations():
    poses, points = relief(6, 30, seed=1)
    joint = total_covariance(poses, points, INTRINSICS, np.ones((6, 30), bool), 0.1).joint()
    a, b = np.array([0, 3]), np.array([7, 20])
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(90), joint, 20000, method="eigh").reshape(-1, 30, 3)
    moved = points + draws
    lengths = np.linalg.norm(moved[:, a] - moved[:, b], axis=2)
    # 20 000 draws know a standard deviation to 0.5 %; four of that.
    np.testing.assert_allclose(length_uncertainty(points, joint, a, b), lengths.std(axis=0), rtol=0.02)
    line, first, second = chosen_lengths(points * [1, 1, 0], np.ones(30, bool))
    assert set(line.tolist()) == {0, 1, 2, 3, 4, 5}  # a flat object has no seventh line
    assert (first != second).all()
