"""The same networks evaluated by the search kernel, by plain numpy, by the compiled direct form and by COLMAP.

Random networks, occluded ones, and networks that are nearly degenerate: cameras that nearly coincide, stations nearly
on one line, points with two rays at tiny angles down to the search's guard. All agree to 1e-9: at the guard
(det N / (tr N)³ = 1e-6, rays at 0.4 degrees) the condition of N is 1e5, so rounding alone leaves some 1e-11; below it
the kernel refuses the network, which must be for that reason.
"""

import numpy as np
import pycolmap
import pytest
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st

from netdesign.model.frames import inverse
from netdesign.photogrammetry.limited_error import WEAK, direct_covariance, limited_covariance
from netdesign.placement.problem import Problem
from tests.bundle_cases import observe
from tests.scenes import CAMERA, box_scene, plate_scene
from tests.test_limited_error import moment_variances
from tests.test_placement import task_of
from tests.test_third_opinions import _colmap

SIGMA, RADIUS, FOCAL = 0.1, 0.6, 3600.0
SEEDS = st.integers(0, 10**6)


@pytest.fixture(scope="module")
def plate():
    return Problem.build(task_of(plate_scene(side=4), max_images=12))


@pytest.fixture(scope="module")
def box():
    return Problem.build(task_of(box_scene(spacing=0.07), max_images=16, min_rays=3))


@pytest.fixture(scope="module")
def admissible(box):
    """Viewpoints (k, 2) of networks that the box admits."""
    bits, genes = box.seeds()
    good = box.evaluate(bits, genes)[1] <= 0
    return [own[used] for used, own in zip(bits[good], genes[good], strict=True)]


def by_numpy(poses, points, visible):
    """(m, 3, 3) from the textbook's collinearity equations: x = f X/Z, y = f Y/Z, no loop over anything but images."""
    normal = np.zeros((len(points), 3, 3))
    for cam_from_world, seen in zip(inverse(poses), visible, strict=True):
        x, y, z = (points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]).T
        zero = np.zeros_like(z)
        of_camera = np.stack([FOCAL / z, zero, -FOCAL * x / z**2, zero, FOCAL / z, -FOCAL * y / z**2], axis=1)
        derivative = of_camera.reshape(-1, 2, 3) @ cam_from_world[:3, :3]
        normal += np.where(seen[:, None, None], np.swapaxes(derivative, 1, 2) @ derivative / SIGMA**2, 0.0)
    return np.linalg.inv(normal), normal


def by_colmap(poses, points, visible):
    """(m, 3, 3) with the poses held."""
    observations = observe(poses, points, visible, SIGMA, intrinsics=CAMERA.intrinsics, noise=False)
    reconstruction, adjuster = _colmap(poses, points, observations, CAMERA.intrinsics)
    options = pycolmap.BACovarianceOptions()
    options.params, options.damping = pycolmap.BACovarianceOptionsParams.POINTS, 0.0
    found = pycolmap.estimate_ba_covariance(options, reconstruction, adjuster)
    return np.array([found.get_point_cov(j + 1) for j in range(len(points))]) * SIGMA**2


def agree(problem, viewpoints):
    """Whether the kernel takes the network, after every evaluation of it has been compared."""
    slots = problem.chromosomes.slots
    bits, genes = (np.arange(slots) < len(viewpoints))[None], np.zeros((1, slots, 2))
    genes[0, : len(viewpoints)] = problem.chromosomes.folded(viewpoints)
    viewpoints = genes[0, : len(viewpoints)]
    points, poses, visible = problem.task.scene.targets.points, problem.poses(viewpoints), problem.visible(viewpoints)
    objectives, violation = problem.evaluate(bits, genes)
    rays, tags = visible.sum(axis=0), visible.sum(axis=1) // 4
    if rays.min() < problem.task.limits.min_rays or tags.min() < problem.min_tags:
        assert violation[0] >= 1
        return False
    plain, normal = by_numpy(poses, points, visible)
    quality = np.linalg.det(normal / np.trace(normal, axis1=1, axis2=2)[:, None, None])
    if violation[0] > 0:
        # As many points as it says are below the guard, but for those that stand on it.
        assert (quality < WEAK * (1 - 1e-9)).sum() <= violation[0] <= (quality < WEAK * (1 + 1e-9)).sum()
        return False
    assert quality.min() > WEAK * (1 - 1e-9)
    scale = np.trace(plain, axis1=1, axis2=2)[:, None, None]
    for other in (
        limited_covariance(poses, points, CAMERA.intrinsics, visible, SIGMA),
        direct_covariance(poses, points, CAMERA.intrinsics, visible, np.array([[SIGMA]])),
        by_colmap(poses, points, visible),
    ):
        np.testing.assert_allclose(other / scale, plain / scale, rtol=0, atol=1e-9)
        assert objectives[0, 0] == pytest.approx(np.trace(other, axis1=1, axis2=2).mean() / 3, rel=1e-9)
    variances, weak = moment_variances(viewpoints, points, visible, RADIUS, FOCAL, np.full(visible.shape, SIGMA))
    assert weak == 0
    np.testing.assert_allclose(variances, np.diagonal(plain, axis1=1, axis2=2), rtol=1e-9)
    return True


def steps_from(viewpoint, distance, bearing):
    """A viewpoint at a distance in rad along the sphere, for distances that are small."""
    return viewpoint + distance * np.array([np.cos(bearing) / np.cos(viewpoint[1]), np.sin(bearing)])


def stations(problem, seed, count):
    """Random viewpoints, most of them where all of a plate is seen."""
    viewpoints = problem.chromosomes.uniform(np.random.default_rng(seed), (count,))
    viewpoints[:, 1] = np.maximum(viewpoints[:, 1], 0.55)
    return viewpoints


@given(SEEDS, st.integers(2, 12))
@settings(deadline=None, max_examples=150)
def test_random_networks(plate, seed, count):
    viewpoints = stations(plate, seed, count)
    event(f"taken: {agree(plate, viewpoints)}")


@given(SEEDS, st.floats(-2.6, -0.5), st.floats(0, 2 * np.pi))
@settings(deadline=None, max_examples=200)
def test_two_rays_at_tiny_angles_down_to_the_guard(plate, seed, exponent, bearing):
    """From 0.14 to 18 degrees between the two stations: the guard is in between."""
    first = np.array([np.random.default_rng(seed).uniform(-3, 3), 1.2])
    event(f"taken: {agree(plate, np.array([first, steps_from(first, 10**exponent, bearing)]))}")


@given(SEEDS, st.integers(2, 8), st.floats(-9, -2), st.floats(0, 2 * np.pi), st.integers(1, 3))
@settings(deadline=None, max_examples=150)
def test_cameras_that_nearly_coincide(plate, seed, count, exponent, bearing, copies):
    viewpoints = stations(plate, seed, count)
    copied = [steps_from(viewpoints[0], step * 10**exponent, bearing) for step in range(1, copies + 1)]
    event(f"taken: {agree(plate, np.concatenate([viewpoints, copied]))}")


@given(SEEDS, st.integers(2, 12), st.floats(-2, 0), st.floats(-9, -1), st.floats(0, 2 * np.pi))
@settings(deadline=None, max_examples=150)
def test_stations_nearly_on_a_line(plate, seed, count, length, width, bearing):
    """A short arc of the sphere, its stations off it by far less than its length."""
    rng = np.random.default_rng(seed)
    middle = np.array([rng.uniform(-3, 3), 1.1])
    along = 10**length * np.linspace(-0.5, 0.5, count)
    viewpoints = np.array([steps_from(middle, step, bearing) for step in along])
    viewpoints += 10**width * 10**length * rng.uniform(-0.5, 0.5, viewpoints.shape)
    event(f"taken: {agree(plate, viewpoints)}")


@given(SEEDS, st.floats(-6, -0.5), st.integers(0, 2))
@settings(deadline=None, max_examples=100)
def test_occluded_networks(box, admissible, seed, exponent, twins):
    """Around a box, where no image sees more than three of its five sides; with cameras doubled, and moved."""
    rng = np.random.default_rng(seed)
    viewpoints = admissible[rng.integers(len(admissible))]
    moved = [steps_from(one, 10**exponent, rng.uniform(0, 7)) for one in rng.permutation(viewpoints)[:twins]]
    viewpoints = np.concatenate([viewpoints, np.reshape(moved, (-1, 2))])[: box.chromosomes.slots]
    visible = box.visible(viewpoints)
    assume(visible.sum(axis=0).min() >= 3)
    assert not visible.all(axis=1).any()
    event(f"taken: {agree(box, viewpoints)}")
