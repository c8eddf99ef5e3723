"""Uncertainty in the robot's frame: pose priors against the notes' numbers, and against poses drawn from them."""

import numpy as np
import pytest

from netdesign.adjustment.absolute import absolute_comparison, absolute_prediction, repeatability_priors
from netdesign.adjustment.problem import BundleProblem
from netdesign.model.frames import exp_rotation, look_at, pose, sphere_directions
from netdesign.model.network import Observations
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.total_error import total_covariance
from tests.scenes import CAMERA

SIGMA = 0.1
REALISATIONS = 60


def network(images=8, count=40, seed=0):
    """A box-shaped cloud of points that all images see from 0.6 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [0.12, 0.12, 0.06]
    alpha = np.arange(images) * 2 * np.pi / images + 0.1
    beta = np.where(np.arange(images) % 2, np.radians(35), np.radians(65))
    return look_at(0.6 * sphere_directions(np.stack([alpha, beta], axis=1)), np.zeros(3)), points


def promised(poses, points, position, rotation):
    visible = np.ones((len(poses), len(points)), dtype=np.bool_)
    priors = repeatability_priors((position, rotation), poses)
    return absolute_prediction(points, priors, CAMERA.intrinsics, visible, np.full(visible.shape, SIGMA))


def test_no_stated_repeatability_is_no_prior():
    assert repeatability_priors((0.0, 0.0), network()[0]) is None
    assert np.isinf(repeatability_priors((1e-4, 0.0), network()[0]).sigma_rotation).all()


def test_exact_poses_are_limited_propagation_and_loose_ones_grow_with_the_robot():
    """The rows of the adjustment notes' table (section 3): from the limited sigma at 1 um up, steeply."""
    poses, points = network()
    visible = np.ones((len(poses), len(points)), dtype=np.bool_)
    limited = limited_covariance(poses, points, CAMERA.intrinsics, visible, SIGMA)
    exact = np.sqrt(np.einsum("mii->m", limited).mean() / 3.0)
    assert promised(poses, points, 1e-8, 1e-8) == pytest.approx(exact, rel=1e-3)
    steps = [promised(poses, points, sigma, sigma * 1e0) for sigma in (1e-6, 1e-5, 1e-4, 1e-3)]
    assert (np.diff(steps) > 0).all()
    # A frame known only through the robot: ten times the repeatability, ten times the uncertainty.
    assert steps[3] / steps[2] == pytest.approx(10, rel=0.05)
    shape = np.sqrt(total_covariance(poses, points, CAMERA.intrinsics, visible, SIGMA).precision.mean_variance)
    assert steps[3] > shape


def test_positions_alone_carry_the_frame():
    poses, points = network()
    both, positions = promised(poses, points, 1e-4, 1e-4), promised(poses, points, 1e-4, 0.0)
    assert both < positions < np.inf


def test_achieved_is_what_was_predicted():
    """True poses and image points drawn from what is assumed: the mean squared ratio is 1 within its own scatter."""
    poses, points = network()
    priors = repeatability_priors((2e-4, 5e-4), poses)
    image, point = (index.ravel() for index in np.indices((len(poses), len(points))))
    squares, inside = [], 0
    for seed in range(REALISATIONS):
        rng = np.random.default_rng([5, seed])
        error = pose(exp_rotation(rng.normal(0, 5e-4, (len(poses), 3))), rng.normal(0, 2e-4, (len(poses), 3)))
        xy_px, _ = project((poses @ error)[image], points[point], CAMERA.intrinsics)
        problem = BundleProblem(
            observations=Observations(
                image=image, point=point, xy_px=xy_px + rng.normal(0, SIGMA, xy_px.shape),
                covariance=np.tile(SIGMA**2 * np.eye(2), (len(image), 1, 1)),
            ),
            camera_of_image=np.zeros(len(poses), dtype=np.int64), intrinsics=CAMERA.intrinsics[None],
            world_from_cam=poses, points=points, image_names=[str(i) for i in range(len(poses))],
            point_names=[str(j) for j in range(len(points))],
        )  # fmt: skip
        found = absolute_comparison(points, problem, priors, 0.99)
        squares.append(found.rho.value**2)
        inside += found.rho.inside
        assert found.predicted_rms == pytest.approx(promised(poses, points, 2e-4, 5e-4), rel=0.02)
    # The frame has 7 degrees of freedom at least: sd of a square below sqrt(2/3), of the mean of 60 below 0.106.
    assert abs(np.mean(squares) - 1.0) < 3.5 * np.sqrt(2 / 3 / REALISATIONS)
    assert inside >= REALISATIONS - 4
