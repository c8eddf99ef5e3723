import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from netdesign.model.frames import exp_rotation, look_at, pose
from netdesign.photogrammetry.datum import inner_basis, point_null_space
from netdesign.photogrammetry.observation_equations import parameter_matrix
from netdesign.photogrammetry.total_error import total_covariance
from netdesign.photogrammetry.total_trace import block_trace, propagated, total_trace
from tests.bundle_cases import (
    INTRINSICS,
    bordered_covariance,
    dense_design,
    observe,
    random_visibility,
    relative,
    relief,
)


def _reference(poses, points, visible, sigma, refine=()):
    matrix = parameter_matrix(refine, INTRINSICS)
    design, _ = dense_design(poses, points, observe(poses, points, visible, sigma), matrix=matrix)
    borders = np.zeros((design.shape[1], 7))
    borders[-3 * len(points) :] = point_null_space(points)
    return bordered_covariance(design, borders)[-3 * len(points) :, -3 * len(points) :]


@pytest.mark.parametrize(
    ("images", "count", "share", "refine"),
    [
        (2, 20, 1.0, ()),
        (4, 28, 0.9, ()),
        (10, 60, 0.6, ()),
        (5, 30, 1.0, ("f", "cx", "cy", "k1", "k2", "p1", "p2")),
        (8, 40, 0.7, ("fx", "fy", "cx", "cy", "k1")),
    ],
)
def test_joint_covariance_equals_dense_bordered_solution(images, count, share, refine):
    poses, points = relief(images, count, seed=images)
    visible = random_visibility(images, count, share, least=min(3, images))
    total = total_covariance(poses, points, INTRINSICS, visible, 0.1, refine)
    assert total.determined, total.diagnosis
    reference = _reference(poses, points, visible, 0.1, refine)
    joint = total.joint()
    assert relative(joint, reference) < 1e-9
    index = np.arange(count)
    blocks = joint.reshape(count, 3, count, 3)[index, :, index, :]
    assert relative(total.covariance, blocks) < 1e-11
    assert total.trace == pytest.approx(np.trace(joint), rel=1e-11)


def test_trace_kernel_equals_full_solution():
    for seed in range(4):
        poses, points = relief(6 + seed, 40, seed=seed)
        visible = random_visibility(len(poses), 40, 0.6, seed)
        sigma = np.random.default_rng(seed).uniform(0.05, 0.2, visible.shape)
        total = total_covariance(poses, points, INTRINSICS, visible, sigma)
        fast = total_trace(poses, points, INTRINSICS, visible, sigma, inner_basis(points))
        assert fast == pytest.approx(total.trace, rel=1e-9)
    one = total_trace(poses, points, INTRINSICS, visible, np.array([[0.1]]), inner_basis(points))
    assert one == pytest.approx(total_covariance(poses, points, INTRINSICS, visible, 0.1).trace, rel=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_trace_kernel_finds_what_is_open_however_many_images(seed):
    """Two halves that share up to four points, or an image that sees up to four: determined from three points on."""
    rng = np.random.default_rng(seed)
    images, count, shared = int(rng.integers(6, 41)), int(rng.integers(20, 100)), seed % 5
    poses, points = relief(images, count, seed=seed)
    visible = random_visibility(images, count, rng.uniform(0.5, 1.0), seed)
    if seed % 2:
        visible[: images // 2, count // 2 + shared :] = False
        visible[images // 2 :, : count // 2] = False
    else:
        visible[0], visible[0, :shared] = False, True
    sigma = np.array([[0.1]])
    total = total_covariance(poses, points, INTRINSICS, visible, 0.1)
    found = total_trace(poses, points, INTRINSICS, visible, sigma, inner_basis(points))
    assert found == pytest.approx(total.trace if total.determined else np.inf, rel=1e-9)


def test_trace_kernel_has_the_same_bits_on_any_number_of_blas_threads():
    poses, points = relief(20, 150, seed=1)
    visible = random_visibility(20, 150, 0.5)
    arguments = poses, points, INTRINSICS, visible, np.array([[0.1]])
    found = set()
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.add((total_trace(*arguments, inner_basis(points)), block_trace(*arguments)))
            assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {threads}
    assert len(found) == 1


def test_functions_of_the_points_equal_the_joint_covariance():
    for seed in range(3):
        poses, points = relief(5 + seed, 30, seed=seed)
        visible = random_visibility(len(poses), 30, 0.7, seed)
        total = total_covariance(poses, points, INTRINSICS, visible, 0.1)
        basis = inner_basis(points)
        functions = np.random.default_rng(seed).normal(size=(3 * len(points), 3))
        functions -= basis @ (basis.T @ functions)
        found = propagated(poses, points, INTRINSICS, visible, np.array([[0.1]]), np.hstack([basis, functions]))
        assert found[0] == pytest.approx(total.trace, rel=1e-9)
        np.testing.assert_allclose(found[1:], np.diag(functions.T @ total.joint() @ functions), rtol=1e-8)


def test_the_block_diagonal_middle_equals_its_dense_formula():
    """tr D + Σ_i tr(S_ii⁻¹ B_iᵀ B_i) (notes, adjustment, section 4), from the dense normal equations."""
    for seed in range(3):
        poses, points = relief(4 + seed, 25, seed=seed)
        visible = random_visibility(len(poses), 25, 0.8, seed)
        sigma = np.array([[0.1]])
        design, _ = dense_design(poses, points, observe(poses, points, visible, 0.1))
        normal, cameras = design.T @ design, 6 * len(poses)
        pp, pc, cc = normal[cameras:, cameras:], normal[cameras:, :cameras], normal[:cameras, :cameras]
        limited = np.linalg.inv(pp)
        coupling = limited @ pc
        schur = cc - pc.T @ coupling
        expected = np.trace(limited)
        for first in range(0, cameras, 6):
            own = slice(first, first + 6)
            expected += np.trace(np.linalg.inv(schur[own, own]) @ coupling[:, own].T @ coupling[:, own])
        found = block_trace(poses, points, INTRINSICS, visible, sigma)
        assert found == pytest.approx(expected, rel=1e-8)
        total = total_covariance(poses, points, INTRINSICS, visible, sigma)
        assert found >= np.trace(total.limited, axis1=1, axis2=2).sum()
    alone = visible.copy()
    alone[0, 2:] = False  # two points do not hold an image
    assert block_trace(poses, points, INTRINSICS, alone, sigma) == np.inf


def test_laws_rigid_motion_scale_and_noise():
    poses, points = relief(6, 30, seed=1)
    visible = random_visibility(6, 30)
    base = total_covariance(poses, points, INTRINSICS, visible, 0.1)
    rotation = exp_rotation(np.array([0.3, -0.7, 1.1]))
    motion = pose(rotation, np.array([1.0, -2.0, 0.5]))
    moved = total_covariance(motion @ poses, points @ rotation.T + [1.0, -2.0, 0.5], INTRINSICS, visible, 0.1)
    np.testing.assert_allclose(moved.covariance, rotation @ base.covariance @ rotation.T, rtol=0, atol=1e-18)
    scaled_poses = poses.copy()
    scaled_poses[:, :3, 3] *= 1000
    scaled = total_covariance(scaled_poses, 1000 * points, INTRINSICS, visible, 0.1)
    np.testing.assert_allclose(scaled.covariance, 1e6 * base.covariance, rtol=1e-9, atol=1e-18)
    assert total_covariance(poses, points, INTRINSICS, visible, 0.2).trace == pytest.approx(4 * base.trace, rel=1e-12)
    shuffle = np.random.default_rng(0).permutation(6)
    shuffled = total_covariance(poses[shuffle], points, INTRINSICS, visible[shuffle], 0.1)
    np.testing.assert_allclose(shuffled.covariance, base.covariance, rtol=1e-9, atol=1e-20)


def test_inner_constraints_have_the_smallest_trace_and_zero_projection():
    poses, points = relief(5, 25, seed=2)
    joint = total_covariance(poses, points, INTRINSICS, np.ones((5, 25), bool), 0.1).joint()
    assert np.abs(joint @ inner_basis(points)).max() < 1e-12 * np.abs(joint).max()


def test_limited_part_is_the_inverse_of_the_point_normals():
    poses, points = relief(4, 10)
    visible = random_visibility(4, 10)
    design, _ = dense_design(poses, points, observe(poses, points, visible, 0.1))
    total = total_covariance(poses, points, INTRINSICS, visible, 0.1)
    normal = design.T @ design
    for j in range(10):
        start = 24 + 3 * j
        block = np.linalg.inv(normal[start : start + 3, start : start + 3])
        np.testing.assert_allclose(total.limited[j], block, rtol=1e-10, atol=1e-16)


def _undetermined(poses, points, visible, words):
    total = total_covariance(poses, points, INTRINSICS, visible, 0.1)
    assert not total.determined
    assert np.isinf(total.covariance).all()
    assert words in "; ".join(total.diagnosis)
    assert total_trace(poses, points, INTRINSICS, visible, np.array([[0.1]]), inner_basis(points)) == np.inf
    with pytest.raises(ValueError, match="not determined"):
        total.joint()


def test_broken_networks_are_named():
    poses, points = relief(6, 30, seed=4)
    visible = np.ones((6, 30), bool)
    once = visible.copy()
    once[1:, 3] = False
    _undetermined(poses, points, once, "seen in one image only")
    blind = visible.copy()
    blind[5, 2:] = False
    _undetermined(poses, points, blind, "image 5 sees 2 point(s)")
    blocks = visible.copy()
    blocks[:3, 15:] = False
    blocks[3:, :15] = False
    _undetermined(poses, points, blocks, "2 blocks of images have no common point: 0, 1, 2 | 3, 4, 5")
    hinge = blocks.copy()
    hinge[:3, 15] = True  # one common point: the blocks turn about it and scale freely
    _undetermined(poses, points, hinge, "not determined; poses of images")
    same = poses.copy()
    same[1] = look_at(poses[0, :3, 3], np.array([0.05, 0.0, 0.0]))
    both = np.zeros((6, 30), bool)
    both[:2] = True
    _undetermined(same[:2], points, both[:2], "seen from one position only")


def test_coinciding_images_among_others_are_harmless():
    poses, points = relief(5, 30, seed=4)
    poses[1] = poses[0]
    assert total_covariance(poses, points, INTRINSICS, np.ones((5, 30), bool), 0.1).determined


def test_weak_network_is_flagged_with_its_images():
    poses, points = relief(8, 60, seed=5)
    visible = np.zeros((8, 60), bool)
    visible[:4, :31], visible[4:, 28:] = True, True  # two blocks tied by three points
    total = total_covariance(poses, points, INTRINSICS, visible, 0.1)
    assert total.determined
    assert total.ratio > 1.5
    text = "; ".join(total.diagnosis)
    assert "total / limited variance" in text
    assert "hang on the rest by 3 point(s)" in text
    strong = total_covariance(poses, points, INTRINSICS, np.ones((8, 60), bool), 0.1)
    assert strong.diagnosis == ()
    assert strong.ratio < 1.1
    assert strong.lambda8 > 10 * total.lambda8
