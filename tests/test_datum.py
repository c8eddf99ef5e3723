import numpy as np
import pytest

from netdesign.model.frames import exp_rotation, similarity
from netdesign.photogrammetry.collinearity import project, project_with_jacobians
from netdesign.photogrammetry.datum import (
    blocks,
    datum_operator,
    inner_basis,
    point_null_space,
    pose_null_space,
    s_transformation,
)
from netdesign.photogrammetry.total_error import total_covariance
from tests.bundle_cases import INTRINSICS, relative, relief


def test_the_null_space_changes_no_image_point():
    poses, points = relief(4, 12)
    centre = points.mean(axis=0)
    projection = project_with_jacobians(poses[:, None], points[None], INTRINSICS)
    by_pose = np.einsum("nmij,njg->nmig", projection.d_xy_d_pose, pose_null_space(poses, centre).reshape(4, 6, 7))
    by_point = np.einsum("nmij,mjg->nmig", projection.d_xy_d_point, point_null_space(points).reshape(12, 3, 7))
    assert np.abs(by_pose + by_point).max() < 1e-12 * np.abs(by_pose).max()


def test_a_finite_similarity_changes_no_image_point():
    poses, points = relief(3, 5)
    rotation, shift, scale = exp_rotation(np.array([0.2, 0.4, -1.0])), np.array([1.0, 2, 3]), 1.7
    moved = poses.copy()
    moved[:, :3, :3] = rotation @ poses[:, :3, :3]
    moved[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + shift
    before, _ = project(poses[:, None], points[None], INTRINSICS)
    after, _ = project(moved[:, None], (scale * points @ rotation.T + shift)[None], INTRINSICS)
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-9)


def test_basis_spans_the_null_space_whatever_the_unit():
    _, points = relief(2, 10)
    for unit in (1.0, 1e3, 1e-3):
        basis = inner_basis(unit * points)
        np.testing.assert_allclose(basis.T @ basis, np.eye(7), atol=1e-14)
        g = point_null_space(unit * points + 5 * unit)
        residual = g - basis @ (basis.T @ g)
        assert (np.linalg.norm(residual, axis=0) < 1e-12 * np.linalg.norm(g, axis=0)).all()
    line = np.outer(np.arange(5.0), [1.0, 2, 3])
    with pytest.raises(ValueError, match="not on one line"):
        inner_basis(line)
    with pytest.raises(ValueError, match="at least 3"):
        inner_basis(points[:2])


def test_s_transformation_laws():
    poses, points = relief(5, 30, seed=2)
    free = total_covariance(poses, points, INTRINSICS, np.ones((5, 30), bool), 0.1).joint()
    some = np.arange(30) < 9
    moved = s_transformation(free, points, some)
    assert relative(s_transformation(moved, points), free) < 1e-10  # there and back
    assert relative(s_transformation(moved, points, some), moved) < 1e-12  # idempotent
    g = point_null_space(points)
    assert np.abs((g * np.repeat(some, 3)[:, None]).T @ moved).max() < 1e-12 * np.abs(moved).max()
    assert np.trace(free) < np.trace(moved)  # all points: the smallest trace
    of_some = np.trace(blocks(moved)[some], axis1=1, axis2=2).sum()
    assert of_some < np.trace(blocks(free)[some], axis1=1, axis2=2).sum()  # chosen points: the smallest over them
    operator = datum_operator(points, some)
    np.testing.assert_allclose(operator @ g, np.eye(7), atol=1e-10)
    with pytest.raises(ValueError, match="2 points do not fix 7"):
        datum_operator(points, np.arange(30) < 2)


@pytest.mark.parametrize(("some", "parameters"), [(30, 7), (12, 7), (12, 6)])
def test_s_transformation_is_what_a_helmert_alignment_does(some, parameters):
    poses, points = relief(5, 30, seed=3)
    free = total_covariance(poses, points, INTRINSICS, np.ones((5, 30), bool), 0.1).joint()
    rng = np.random.default_rng(1)
    wide = free + 1e-10 * point_null_space(points) @ point_null_space(points).T  # some other datum
    draws = rng.multivariate_normal(np.zeros(90), wide, 4000, method="eigh").reshape(-1, 30, 3)
    mask = np.arange(30) < some
    aligned = []
    for draw in draws:
        scale, rotation, translation = similarity((points + draw)[mask], points[mask], with_scale=parameters == 7)
        aligned.append(scale * (points + draw) @ rotation.T + translation - points)
    achieved = (np.array(aligned) ** 2).sum(axis=(1, 2)).mean()
    joint = s_transformation(wide, points, mask, parameters)
    values = np.linalg.eigvalsh(joint)
    nu_eff = values.sum() ** 2 / (values**2).sum()
    assert achieved == pytest.approx(np.trace(joint), rel=4 * np.sqrt(2 / (nu_eff * 4000)))
