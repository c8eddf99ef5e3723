import gtsam
import numpy as np
import pytest

from netdesign.model.frames import exp_rotation, pose
from netdesign.photogrammetry.collinearity import project, project_with_jacobians
from tests.bundle_cases import INTRINSICS, relief


def _moved(world_from_cam, xi):
    rotation = world_from_cam[:3, :3] @ exp_rotation(xi[:3])
    return pose(rotation, world_from_cam[:3, 3] + world_from_cam[:3, :3] @ xi[3:])


def _central(function, size, step):
    return np.stack([(function(d) - function(-d)) / (2 * step) for d in step * np.eye(size)], axis=1)


def test_jacobians_match_central_differences():
    poses, points = relief(3, 4)
    for camera in poses:
        for point in points:
            exact = project_with_jacobians(camera, point, INTRINSICS)
            step = 1e-6
            pose_numeric = _central(lambda d, c=camera, p=point: project(_moved(c, d), p, INTRINSICS)[0], 6, step)
            point_numeric = _central(lambda d, c=camera, p=point: project(c, p + d, INTRINSICS)[0], 3, step)
            np.testing.assert_allclose(exact.d_xy_d_pose, pose_numeric, rtol=1e-6, atol=1e-4)
            np.testing.assert_allclose(exact.d_xy_d_point, point_numeric, rtol=1e-6, atol=1e-4)
            for column, scale in enumerate([1, 1, 1, 1, 1e-4, 1e-4, 1e-5, 1e-5]):
                d = np.zeros(8)
                d[column] = scale
                numeric = (project(camera, point, INTRINSICS + d)[0] - project(camera, point, INTRINSICS - d)[0]) / (
                    2 * scale
                )
                np.testing.assert_allclose(exact.d_xy_d_intrinsics[:, column], numeric, rtol=1e-8, atol=1e-8)


def test_agrees_with_gtsam_to_rounding():
    poses, points = relief(6, 20, seed=3)
    calibration = gtsam.Cal3DS2(3600.0, 3590.0, 0.0, 1223.5, 1023.5, -0.08, 0.12, 4e-4, -3e-4)
    unit = gtsam.noiseModel.Unit.Create(2)
    order = gtsam.Ordering()
    for key in (1, 2, 3):
        order.push_back(key)
    # gtsam's vector is fx, fy, skew, u0, v0, k1, k2, p1, p2
    ours_of_gtsam = [0, 1, 3, 4, 5, 6, 7, 8]
    worst = 0.0
    for camera in poses:
        for point in points:
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(np.zeros(2), unit, 1, 2, 3))
            values.insert(1, gtsam.Pose3(camera))
            values.insert(2, point)
            values.insert(3, calibration)
            jacobian, right = graph.linearize(values).jacobian(order)
            ours = project_with_jacobians(camera, point, INTRINSICS)
            mine = np.hstack([ours.d_xy_d_pose, ours.d_xy_d_point, ours.d_xy_d_intrinsics])
            theirs = np.hstack([jacobian[:, :9], jacobian[:, 9:][:, ours_of_gtsam]])
            worst = max(
                worst, np.abs(mine - theirs).max() / np.abs(theirs).max(), np.abs(ours.xy_px + right).max() / 3600
            )
    assert worst < 1e-12


def test_leading_axes_broadcast_and_depth_tells_what_is_behind():
    poses, points = relief(4, 5)
    xy, depth = project(poses[:, None], points[None], INTRINSICS)
    assert xy.shape == (4, 5, 2)
    assert depth.shape == (4, 5)
    single, _ = project(poses[2], points[3], INTRINSICS)
    np.testing.assert_array_equal(xy[2, 3], single)
    behind = poses[0, :3, 3] - 0.5 * poses[0, :3, 2]
    assert project(poses[0], behind, INTRINSICS)[1] == pytest.approx(-0.5)
    full = project_with_jacobians(poses[:, None], points[None], INTRINSICS)
    assert full.d_xy_d_pose.shape == (4, 5, 2, 6)
    np.testing.assert_array_equal(full.xy_px, xy)
