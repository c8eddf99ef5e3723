"""Points adjusted from tags whose corners err together: the law of independent corners, dense algebra, sampling."""

import numpy as np
import pytest

from netdesign.adjustment.bundle import adjust
from netdesign.adjustment.compare import point_equations
from netdesign.adjustment.correlated import correlated_errors
from netdesign.adjustment.statistics import SumsOfSquares, f_interval
from netdesign.model.network import Observations
from netdesign.photogrammetry.datum import inner_basis
from tests.bundle_cases import camera_of, observe, random_visibility, relief

IMAGES, TAGS, SIGMA = 5, 6, 0.1
# Four corners that share half of their variance.
CENTRE = np.kron(np.full((4, 4), 0.25), np.eye(2))
CORRELATED = SIGMA**2 * (0.5 * np.eye(8) + 2.0 * CENTRE)


@pytest.fixture(scope="module")
def network():
    poses, centres = relief(IMAGES, TAGS, seed=4)
    points = np.repeat(centres, 4, axis=0) + np.tile(0.01 * np.eye(3)[[0, 1, 2, 0]] * [[1], [1], [1], [-1]], (TAGS, 1))
    visible = np.repeat(random_visibility(IMAGES, TAGS, 0.9), 4, axis=1)
    observed = observe(poses, points, visible, SIGMA, seed=1)
    return poses, points, observed, adjust(observed, camera_of(), poses, points)


def _keys(observed):
    return sorted({(i, p // 4) for i, p in zip(observed.image.tolist(), observed.point.tolist(), strict=True)})


def test_independent_corners_give_the_covariance_of_the_adjustment(network):
    *_, observed, adjusted = network
    independent, sums = correlated_errors(adjusted, dict.fromkeys(_keys(observed), SIGMA**2 * np.eye(8)))
    scale = np.sqrt(np.diag(adjusted.joint_covariance))
    np.testing.assert_allclose(
        independent / np.outer(scale, scale), adjusted.joint_covariance / np.outer(scale, scale), atol=1e-5
    )
    nu, r = 12 * TAGS - 7, adjusted.redundancy
    expected = SumsOfSquares.independent(nu, r)
    for name in ("t_mean", "t_variance", "v_mean", "v_variance"):
        assert getattr(sums, name) == pytest.approx(getattr(expected, name), rel=1e-6)
    assert sums.common == pytest.approx(0, abs=1e-5)
    assert sums.ratio_dofs == pytest.approx((nu, r), rel=1e-6)


def test_sums_of_squares_of_correlated_corners_are_those_of_draws(network):
    """Errors drawn tag by tag through dense projections: means, variances, covariance of T and V; F keeps its level."""
    _, points, observed, adjusted = network
    _, sums = correlated_errors(adjusted, dict.fromkeys(_keys(observed), CORRELATED))
    linearised, tag = point_equations(adjusted), observed.point // 4
    order = np.lexsort((observed.point, tag, observed.image))
    design = np.zeros((2 * len(order), linearised.width + 3 * len(points)))
    for row, k in enumerate(order):
        at = slice(2 * row, 2 * row + 2)
        design[at, linearised.columns[k]] = linearised.camera[k]
        first = linearised.width + 3 * observed.point[k]
        design[at, first : first + 3] = linearised.point_part[k]
    stations = np.linalg.qr(design[:, : linearised.width])[0]
    rest = design[:, linearised.width :] - stations @ (stations.T @ design[:, linearised.width :])
    left, singular, _ = np.linalg.svd(rest, full_matrices=False)
    left = left[:, singular > 1e-9 * singular[0]]
    count = 20000
    root = np.linalg.cholesky(CORRELATED) / SIGMA
    errors = (np.random.default_rng(8).standard_normal((count, len(order) // 4, 8)) @ root.T).reshape(count, -1)
    t = ((errors @ left) ** 2).sum(axis=1)
    v = (errors**2).sum(axis=1) - ((errors @ stations) ** 2).sum(axis=1) - t
    # Four standard errors: of a mean sd/sqrt(count), of a variance about sqrt(2/count), of a covariance 1/sqrt(count).
    assert t.mean() == pytest.approx(sums.t_mean, abs=4 * t.std() / np.sqrt(count))
    assert v.mean() == pytest.approx(sums.v_mean, abs=4 * v.std() / np.sqrt(count))
    assert t.var() == pytest.approx(sums.t_variance, rel=6 * np.sqrt(2 / count))
    assert v.var() == pytest.approx(sums.v_variance, rel=6 * np.sqrt(2 / count))
    assert np.cov(t, v)[0, 1] == pytest.approx(sums.common, abs=4 * t.std() * v.std() / np.sqrt(count))
    nu, r = left.shape[1], adjusted.redundancy
    mean = sums.t_mean / nu / (sums.v_mean / r)
    interval = f_interval(1.0, *sums.ratio_dofs, 0.95, mean)
    ratio = t / nu / (v / r)
    outside = np.mean((ratio < interval.low) | (ratio > interval.high))
    assert outside == pytest.approx(0.05, abs=0.02)  # two moments, not the whole distribution
    plain = f_interval(1.0, nu, r, 0.95)
    assert np.mean((ratio < plain.low) | (ratio > plain.high)) > 1.5 * outside


def test_correlated_corners_spread_the_points_as_predicted(network):
    poses, points, observed, adjusted = network
    predicted, _ = correlated_errors(adjusted, dict.fromkeys(_keys(observed), CORRELATED))
    mean_of_tag = np.kron(np.eye(TAGS), np.kron(np.full((1, 4), 0.25), np.eye(3)))
    predicted, ignored = (mean_of_tag @ joint @ mean_of_tag.T for joint in (predicted, adjusted.joint_covariance))
    assert np.trace(predicted) > 1.5 * np.trace(ignored)
    order = np.lexsort((observed.point, observed.image))  # tag by tag
    exact = observe(poses, points, np.ones((IMAGES, 4 * TAGS), bool), 1e-9, seed=1)
    truth = {(i, p): xy for i, p, xy in zip(exact.image, exact.point, exact.xy_px, strict=True)}
    image, point = observed.image[order], observed.point[order]
    at = np.array([truth[i, p] for i, p in zip(image, point, strict=True)])
    root, random = np.linalg.cholesky(CORRELATED), np.random.default_rng(5)
    basis = inner_basis(points)
    squares = []
    for _ in range(60):
        noise = (random.standard_normal((len(order) // 4, 8)) @ root.T).reshape(-1, 2)
        noisy = Observations(
            image=image, point=point, xy_px=at + noise, covariance=np.tile(SIGMA**2 * np.eye(2), (len(order), 1, 1))
        )
        error = (adjust(noisy, camera_of(), poses, points).points - points).ravel()
        error -= basis @ (basis.T @ error)
        squares.append(float(((mean_of_tag @ error) ** 2).sum()))
    values = np.linalg.eigvalsh(predicted)
    nu_eff = values.sum() ** 2 / (values**2).sum()
    # The mean of 60 weighted chi-squares; four standard errors, and it must tell the two predictions apart.
    assert np.mean(squares) == pytest.approx(values.sum(), rel=4 * np.sqrt(2 / (60 * nu_eff)))
