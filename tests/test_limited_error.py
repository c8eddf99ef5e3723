"""Limited error propagation: laws, closed forms, and the three forms against each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netdesign.model.compiled import entry
from netdesign.model.frames import exp_rotation, look_at, pose, sphere_directions
from netdesign.photogrammetry.limited_error import (
    LANES,
    ROWS,
    VARIANCES,
    WEIGHT,
    add_two_cameras,
    block_variances,
    blocked,
    direct_covariance,
    limited_covariance,
)
from tests.scenes import CAMERA, box_scene, ring

POINTS = box_scene().targets.points
SIGMA = 0.1
DISTORTED = np.array([3600.0, 3550, 1223, 1020, -0.11, 0.07, 4e-4, -3e-4])


def stations(count, seed, distance=0.6):
    rng = np.random.default_rng(seed)
    viewpoints = np.stack([rng.uniform(-np.pi, np.pi, count), rng.uniform(0.2, 1.5, count)], axis=1)
    return viewpoints, look_at(distance * sphere_directions(viewpoints), np.zeros(3), rng.uniform(-3, 3, count))


ADD, FINISH = entry()(add_two_cameras), entry()(block_variances)


def moment_variances(viewpoints, points, visible, radius, focal, sigma):
    """(m, 3) by the moment form."""
    places, weights = blocked(points.T).reshape(-1, 3 * LANES), blocked(visible / sigma**2)
    weights = weights.reshape(len(places), len(viewpoints), LANES)
    found, weak = np.zeros((len(places) * LANES, 3)), 0
    for index in range(len(places)):
        block = np.zeros(ROWS * LANES)
        block[: 3 * LANES] = places[index]
        directions = sphere_directions(viewpoints)
        for first in range(0, len(directions), 2):
            second = min(first + 1, len(directions) - 1)
            block[WEIGHT * LANES : (WEIGHT + 2) * LANES] = weights[index][[first, second]].ravel()
            ADD(block, *directions[first], *directions[second], radius, 1.0, float(second > first))
        total, lost = FINISH(block, radius, len(points) - index * LANES)
        weak += lost
        variances = block[VARIANCES * LANES : (VARIANCES + 3) * LANES]
        np.testing.assert_allclose(total, variances.sum(), rtol=1e-12)
        found[index * LANES : (index + 1) * LANES] = variances.reshape(3, LANES).T
    return found[: len(points)] / focal**2, weak


@given(st.integers(3, 20), st.integers(0, 10**6), st.floats(0.5, 1.0), st.booleans())
@settings(deadline=None, max_examples=40)
def test_the_three_forms_agree(count, seed, share, per_sighting):
    viewpoints, poses = stations(count, seed)
    rng = np.random.default_rng(seed)
    visible = rng.random((count, len(POINTS))) < share
    sigma = rng.uniform(0.03, 0.5, visible.shape) if per_sighting else np.full(visible.shape, SIGMA)
    reference = limited_covariance(poses, POINTS, CAMERA.intrinsics, visible, sigma)
    direct = direct_covariance(poses, POINTS, CAMERA.intrinsics, visible, sigma)
    good = np.isfinite(reference[:, 0, 0])
    np.testing.assert_array_equal(good, np.isfinite(direct[:, 0, 0]))
    scale = np.trace(reference[good], axis1=1, axis2=2)[:, None, None]
    # Rounding grows with the square of 1 / intersection angle in every form; 1e-9 of the trace down to 0.4 degrees.
    np.testing.assert_allclose(direct[good] / scale, reference[good] / scale, atol=1e-9)
    variances, weak = moment_variances(viewpoints, POINTS, visible, 0.6, 3600.0, sigma)
    if weak == 0:
        np.testing.assert_allclose(variances, np.diagonal(reference, axis1=1, axis2=2), rtol=1e-9)


def test_direct_form_with_distortion_equals_the_reference():
    _, poses = stations(9, 3)
    visible = np.random.default_rng(3).random((9, len(POINTS))) < 0.7
    reference = limited_covariance(poses, POINTS, DISTORTED, visible, SIGMA)
    direct = direct_covariance(poses, POINTS, DISTORTED, visible, np.array([[SIGMA]]))
    np.testing.assert_allclose(direct, reference, rtol=1e-9, atol=1e-20)


@given(st.integers(3, 8), st.integers(0, 10**6))
@settings(deadline=None, max_examples=30)
def test_one_more_image_never_increases_a_covariance(count, seed):
    _, poses = stations(count + 1, seed)
    visible = np.random.default_rng(seed).random((count + 1, len(POINTS))) < 0.8
    before = limited_covariance(poses[:-1], POINTS, DISTORTED, visible[:-1], SIGMA)
    after = limited_covariance(poses, POINTS, DISTORTED, visible, SIGMA)
    good = np.isfinite(before[:, 0, 0])
    smallest = np.linalg.eigvalsh(before[good] - after[good])[:, 0]
    assert (smallest >= -1e-9 * np.trace(before[good], axis1=1, axis2=2)).all()
    assert np.isfinite(after[good]).all()


@given(st.integers(0, 10**6), st.floats(0.1, 10.0))
@settings(deadline=None, max_examples=20)
def test_scale_and_rigid_motion(seed, scale):
    _, poses = stations(6, seed)
    visible = np.ones((6, len(POINTS)), bool)
    before = limited_covariance(poses, POINTS, DISTORTED, visible, SIGMA)
    scaled = poses.copy()
    scaled[:, :3, 3] *= scale
    larger = limited_covariance(scaled, scale * POINTS, DISTORTED, visible, SIGMA)
    size = scale**2 * np.trace(before, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(larger / size, scale**2 * before / size, atol=1e-9)
    rng = np.random.default_rng(seed)
    motion = pose(exp_rotation(rng.normal(size=3)), rng.normal(size=3))
    moved = limited_covariance(motion @ poses, POINTS @ motion[:3, :3].T + motion[:3, 3], DISTORTED, visible, SIGMA)
    largest = np.linalg.eigvalsh(before)[:, 2:]
    np.testing.assert_allclose(np.linalg.eigvalsh(moved) / largest, np.linalg.eigvalsh(before) / largest, atol=1e-8)
    noisier = limited_covariance(poses, POINTS, DISTORTED, visible, 3 * SIGMA)
    np.testing.assert_allclose(noisier / size, 9 * before / size, rtol=1e-9, atol=1e-12)


@given(st.integers(2, 12), st.integers(0, 10**6))
@settings(deadline=None, max_examples=40)
def test_no_network_beats_the_bound(count, seed):
    """trace Q / 3 >= 1.5 sigma² / Σ S⁻² (reference cases, section 1).

    S = distance / focal length on the axis; at an angle theta off it, 2 / S² = tr JᵀJ = (1 + cos²) / cos⁴ f² / d².
    """
    _, poses = stations(count, seed)
    visible = np.ones((count, len(POINTS)), bool)
    covariance = limited_covariance(poses, POINTS, CAMERA.intrinsics, visible, SIGMA)
    distance = np.linalg.norm(poses[:, None, :3, 3] - POINTS, axis=2)
    cosine = np.einsum("nj,nmj->nm", -poses[:, :3, 2], poses[:, None, :3, 3] - POINTS) / distance
    wide = 0.5 * (1 + cosine**2) / cosine**4
    bound = 1.5 * SIGMA**2 / (wide * (3600.0 / distance) ** 2).sum(axis=0)
    assert (np.trace(covariance, axis1=1, axis2=2) / 3 >= bound * (1 - 1e-12)).all()


def test_the_bound_is_reached_by_a_tight_frame():
    half_angle = np.arccos(1 / np.sqrt(3))
    poses = ring(4, elevation_deg=90 - np.degrees(half_angle))
    covariance = limited_covariance(poses, np.zeros((1, 3)), CAMERA.intrinsics, np.ones((4, 1), bool), SIGMA)
    sigma = np.sqrt(np.trace(covariance[0]) / 3)
    assert sigma * 2.0 == pytest.approx(np.sqrt(1.5) * SIGMA * 0.6 / 3600, rel=1e-12)
    assert covariance[0] == pytest.approx(np.eye(3) * sigma**2, abs=1e-12 * sigma**2)


def test_stereo_normal_case():
    """sigma_Z = √2 S (Z/B) sigma, sigma_X = S sigma / √2 on the mid-line."""
    depth, base = 2.0, 0.3
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = [-base / 2, base / 2]
    covariance = limited_covariance(poses, np.array([[0, 0, depth]]), CAMERA.intrinsics, np.ones((2, 1), bool), SIGMA)
    scale = depth / 3600.0 * SIGMA
    deviation = (base / 2 / depth) ** 2
    assert np.sqrt(covariance[0, 2, 2]) == pytest.approx(np.sqrt(2) * scale * depth / base, rel=1e-9)
    assert np.sqrt(covariance[0, 1, 1]) == pytest.approx(scale / np.sqrt(2), rel=deviation + 1e-9)


def test_undetermined_points_are_infinite_and_coincident_cameras_weak():
    _, poses = stations(1, 0)
    twice = np.concatenate([poses, poses])
    visible = np.ones((2, len(POINTS)), bool)
    visible[:, 0] = False
    covariance = limited_covariance(twice, POINTS, CAMERA.intrinsics, visible, SIGMA)
    assert np.isinf(covariance).all()
    assert np.isinf(direct_covariance(twice, POINTS, CAMERA.intrinsics, visible, np.array([[SIGMA]]))).all()
    viewpoints = np.array([[0.3, 0.8], [0.3, 0.8]])
    assert moment_variances(viewpoints, POINTS, np.ones((2, len(POINTS))), 0.6, 3600.0, SIGMA)[1] == len(POINTS)
