"""Points adjusted from tags whose corners err together: the law of independent corners, dense algebra, sampling."""

import numpy as np
import pytest

from netdesign.adjustment.bundle import adjust
from netdesign.adjustment.correlated import correlated_covariance
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
    independent = correlated_covariance(adjusted, dict.fromkeys(_keys(observed), SIGMA**2 * np.eye(8)))
    scale = np.sqrt(np.diag(adjusted.joint_covariance))
    np.testing.assert_allclose(
        independent / np.outer(scale, scale), adjusted.joint_covariance / np.outer(scale, scale), atol=1e-5
    )


def test_correlated_corners_spread_the_points_as_predicted(network):
    poses, points, observed, adjusted = network
    predicted = correlated_covariance(adjusted, dict.fromkeys(_keys(observed), CORRELATED))
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
