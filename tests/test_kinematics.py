"""Inverse kinematics: FK(IK(T)) = T; the closed form's branches are another solver's."""

import numpy as np
import pytest

from netdesign.model.frames import pose
from netdesign.motion.inverse import solve_closed
from netdesign.motion.joint_sheets import free_joints
from netdesign.motion.kinematics import base_from_flange, into_limits, restarts, solve
from netdesign.motion.robot import load_chain
from netdesign.motion.ur_kinematics import ur_arm, ur_branches
from tests.cells import arm, cell

ARMS = ["ur3", "ur5", "ur10", "z1"]


def branches(chain, target):
    geometry = ur_arm(chain)
    q, found = np.zeros((8, 6)), np.zeros(8, dtype=bool)
    ur_branches(geometry.axes, geometry.points, geometry.wrist, geometry.flange_inverse, target, q, found)
    return q[found]


def angle_distance(first, second):
    return np.abs((first - second + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("robot", ["ur3", "ur10", "panda", "kinova", "z1"])
def test_numerical_inverse_closes_the_pose(robot):
    chain = load_chain(cell(robot=robot))
    targets = base_from_flange(chain, restarts(chain, 60, seed=5))
    starts = restarts(chain, 30, seed=6)
    solved = [solve(chain, target, starts) for target in targets]
    # The notes measured 0.99 to 1.00 with 30 restarts on the hardest arms.
    assert sum(found for _, found in solved) >= 58
    for target, (q, found) in zip(targets, solved, strict=True):
        if found:
            np.testing.assert_allclose(base_from_flange(chain, q[None])[0], target, rtol=0, atol=1e-9)
            assert (q >= chain.lower).all()
            assert (q <= chain.upper).all()


def test_joints_that_are_held_stay():
    chain = load_chain(cell(robot="panda"))
    free = free_joints(chain)
    true = restarts(chain, 1, seed=8)[0]
    starts = restarts(chain, 30, seed=9)
    starts[:, ~free] = true[~free]
    q, found = solve(chain, base_from_flange(chain, true[None])[0], starts, free)
    assert found
    np.testing.assert_array_equal(q[~free], true[~free])


@pytest.mark.parametrize("robot", ARMS)
def test_closed_form_closes_the_pose_and_finds_the_joints_it_came_from(robot):
    chain = load_chain(cell(robot=robot))
    for q, target in zip(joints := restarts(chain, 300, seed=7), base_from_flange(chain, joints), strict=True):
        found = branches(chain, target)
        np.testing.assert_allclose(base_from_flange(chain, found) - target, 0, atol=1e-9)
        assert angle_distance(found, q).max(axis=1).min() < 1e-6


def test_branch_set_equals_an_independent_solver():
    """EAIK (Ostermeier et al. 2024) on 1000 random reachable poses of the UR10."""
    from eaik.IK_HP import HPRobot

    chain = load_chain(cell())
    link, axes, points = np.eye(4), [], []
    for placement in chain.placements:
        link = link @ placement
        axes.append(link[:3, 2])
        points.append(link[:3, 3])
    flange = base_from_flange(chain, np.zeros((1, 6)))[0]
    offsets = np.diff(np.array([np.zeros(3), *points, flange[:3, 3]]), axis=0)
    robot = HPRobot(np.array(axes), offsets)
    joints = restarts(chain, 1000, seed=11)
    for q, target in zip(joints, base_from_flange(chain, joints), strict=True):
        ours = branches(chain, target)
        # EAIK's end effector keeps the base's axes at joint values zero.
        answer = robot.IK(pose(target[:3, :3] @ flange[:3, :3].T, target[:3, 3]))
        theirs = np.array([s for s, pseudo in zip(answer.Q, answer.is_LS, strict=True) if not pseudo])
        assert len(ours) == len(theirs), q
        gap = angle_distance(ours[:, None], theirs[None]).max(axis=2)
        assert gap.min(axis=0).max() < 1e-5
        assert gap.min(axis=1).max() < 1e-5


def test_closed_form_is_only_used_where_the_axes_allow_it():
    assert ur_arm(load_chain(cell(robot="xarm7"))) is None
    assert ur_arm(load_chain(cell(robot="panda"))) is None


def test_camera_poses_of_the_cell_are_met_in_the_world():
    cell_arm = arm()
    from tests.scenes import ring

    targets = ring(7)
    q, found = solve_closed(cell_arm, targets)
    assert found.any(axis=1).all()
    for target, solutions, there in zip(targets, q, found, strict=True):
        base = base_from_flange(cell_arm.chain, solutions[there])
        world = cell_arm.cell.world_from_base @ base @ cell_arm.cell.flange_from_cam
        np.testing.assert_allclose(world - target, 0, atol=1e-9)


def test_whole_turns_into_limits():
    q = np.array([4.0, -4.0, 3.5, 9.0])
    lower, upper = np.array([-np.pi, -6.0, 3.0, -1.0]), np.array([np.pi, 6.0, 6.0, 1.0])
    assert not into_limits(q, lower, upper)
    np.testing.assert_allclose(q[:3], [4.0 - 2 * np.pi, 2 * np.pi - 4.0, 3.5])
