"""The URDF becomes a chain: forward kinematics as pinocchio has it, clear errors, locked joints, renamed frames."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from netdesign.errors import InputError
from netdesign.files.robot import bundle_robot, resolve_cell
from netdesign.model.frames import pose, rotation_from_rpy
from netdesign.model.study import RobotTable
from netdesign.motion.catalogue import find_robot, mount
from netdesign.motion.kinematics import base_from_flange, restarts
from netdesign.motion.robot import load_chain
from tests.cells import cell

ROBOTS = ["ur3", "ur5", "ur10", "panda", "xarm7", "kinova", "z1"]


def pinocchio_flange(urdf, frame, names, joints):
    model = pin.buildModelFromUrdf(str(urdf))
    data = model.createData()
    q = pin.neutral(model)
    for name, value in zip(names, joints, strict=True):
        joint = model.joints[model.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(frame)].homogeneous


@pytest.mark.parametrize("robot", ROBOTS)
def test_forward_kinematics_equals_pinocchio(robot):
    chain = load_chain(cell(robot=robot))
    urdf, _, flange = find_robot(robot)
    joints = restarts(chain, 50, seed=1)
    for q, found in zip(joints, base_from_flange(chain, joints), strict=True):
        np.testing.assert_allclose(found, pinocchio_flange(urdf, flange, chain.joint_names, q), rtol=0, atol=1e-12)


def test_meshes_are_where_pinocchio_puts_them():
    setup = cell()
    chain = load_chain(setup)
    model = pin.buildModelFromUrdf(str(setup.urdf))
    geometry = pin.buildGeomFromUrdf(
        model, str(setup.urdf), pin.GeometryType.COLLISION, package_dirs=[str(setup.package_dirs[0])]
    )
    q = restarts(chain, 1, seed=2)[0]
    data, placed = model.createData(), pin.GeometryData(geometry)
    pin.updateGeometryPlacements(model, data, geometry, placed, q)
    link = np.eye(4)
    links = [link]
    for placement, angle in zip(chain.placements, q, strict=True):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        links.append(links[-1] @ placement @ turn)
    for shape in chain.shapes:
        index = geometry.getGeometryId(shape.name)
        expected = placed.oMg[index].homogeneous
        vertices = np.array(geometry.geometryObjects[index].geometry.vertices())
        here = links[shape.link]
        np.testing.assert_allclose(
            shape.vertices @ here[:3, :3].T + here[:3, 3], vertices @ expected[:3, :3].T + expected[:3, 3], atol=1e-12
        )


def test_grippers_and_end_effector_boxes_make_room_for_the_camera():
    assert "ee_link_0" not in [shape.name for shape in load_chain(cell()).shapes]
    panda = load_chain(cell(robot="panda"))
    assert len(panda) == 7
    assert not any("finger" in shape.name or "hand" in shape.name for shape in panda.shapes)


def test_continuous_joints_have_one_value_each_and_wrap():
    chain = load_chain(cell(robot="kinova"))
    assert len(chain) == 6
    assert chain.wraps.tolist() == [True, False, False, True, False, True]
    np.testing.assert_allclose(chain.upper[0], 3 * np.pi)


def test_locked_joints_and_limits_are_taken_over():
    chain = load_chain(cell(robot="panda", lock={"panda_joint3": 0.4}, limits={"panda_joint1": (-1.0, 1.5)}))
    assert len(chain) == 6
    assert (chain.lower[0], chain.upper[0]) == (-1.0, 1.5)
    urdf, _, flange = find_robot("panda")
    q = restarts(chain, 1, seed=3)[0]
    expected = pinocchio_flange(urdf, flange, (*chain.joint_names, "panda_joint3"), (*q, 0.4))
    np.testing.assert_allclose(base_from_flange(chain, q[None])[0], expected, atol=1e-12)


def test_speeds_are_the_smaller_of_urdf_and_study():
    assert load_chain(cell(robot="kinova", speed=0.7)).speed.tolist() == pytest.approx([0.62831853] * 3 + [0.7] * 3)


def test_a_renamed_tool_frame_of_a_user_urdf(tmp_path):
    source = find_robot("ur5")[0]
    renamed = tmp_path / "mine.urdf"
    renamed.write_text(source.read_text().replace('"tool0"', '"camera_plate"'))
    chain = load_chain(_user_cell(renamed, "camera_plate"))
    original = load_chain(cell(robot="ur5"))
    q = restarts(chain, 5, seed=4)
    np.testing.assert_allclose(base_from_flange(chain, q), base_from_flange(original, q), atol=1e-15)
    with pytest.raises(InputError, match="camera_plate"):
        load_chain(_user_cell(renamed, "tool0"))
    with pytest.raises(InputError, match=r"robot\.tool_frame: expected the frame that carries the camera"):
        load_chain(_user_cell(renamed, None))


def test_errors_are_one_clear_line(tmp_path):
    with pytest.raises(InputError, match=r"ur10.*found 'ur11'"):
        find_robot("ur11")
    with pytest.raises(InputError, match=r"nothing\.urdf"):
        load_chain(_user_cell(tmp_path / "nothing.urdf", "tool0"))
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot")
    with pytest.raises(InputError, match=r"broken\.urdf"):
        load_chain(_user_cell(broken, "tool0"))
    lost = tmp_path / "lost.urdf"
    lost.write_text(find_robot("ur5")[0].read_text().replace("collision/base.stl", "collision/gone.stl"))
    with pytest.raises(InputError, match=r"gone\.stl"):
        load_chain(_user_cell(lost, "tool0"))
    with pytest.raises(InputError, match=r"robot\.lock: expected one of shoulder_pan_joint"):
        load_chain(cell(lock={"shoulder": 0.0}))
    with pytest.raises(InputError, match=r"robot\.limits_rad: expected one of"):
        load_chain(cell(limits={"elbow": (0.0, 1.0)}))
    with pytest.raises(InputError, match="camera_mount"):
        mount("top")
    with pytest.raises(InputError, match=r"robot\.limits_rad\.elbow_joint: expected radians.*found \[-150, 150\]"):
        load_chain(cell(limits={"elbow_joint": (-150.0, 150.0)}))
    with pytest.raises(InputError, match=r"robot\.lock\.panda_joint4: expected -3\.\d+ to -0\.\d+ rad, found 90"):
        load_chain(cell(robot="panda", lock={"panda_joint4": 90.0}))
    with pytest.raises(InputError, match=r"robot\.tool_frame: expected the frame .* and \d+ more$") as long:
        load_chain(cell(robot="anymal"))
    assert len(str(long.value)) < 400


def _mounted(matrix):
    """(flange_from_cam m as used, flange_from_cam_mm as a run directory has it)."""
    table = RobotTable(name="ur10", flange_from_cam_mm=tuple(map(tuple, matrix.tolist())))
    return resolve_cell(table, Path()).flange_from_cam, np.array(bundle_robot(table, Path())[0].flange_from_cam_mm)


@pytest.mark.parametrize("digits", [3, 4, 6])
def test_a_camera_mount_with_few_digits_is_a_rotation_all_the_same(digits):
    exact = pose(rotation_from_rpy(np.array([-1.26, 0.31, 2.2])), np.array([12.3, 40.0, 71.5]))
    found, written = _mounted(np.round(exact, digits))
    np.testing.assert_allclose((written * [1, 1, 1, 1e-3])[:3], found[:3], atol=1e-12)
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-15
    assert np.abs(found[:3, :3] - exact[:3, :3]).max() < 2 * 10.0**-digits
    np.testing.assert_allclose(found[:3, 3], exact[:3, 3] * 1e-3, atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda m: m.T, r"last row \[0, 0, 0, 1\], found \[12\.\d*, .*transposed\?"),
        (lambda m: m @ np.diag([1, 1, -1, 1]), "determinant -1"),
        (lambda m: m * np.array([[1.01], [1], [1], [1]]), "singular values 1.01, 1, 1"),
    ],
)
def test_what_is_no_camera_mount_is_said(wrong, message):
    exact = pose(rotation_from_rpy(np.array([-1.5, 0.3, 0.0])), np.array([12.3, 40.0, 71.5]))
    with pytest.raises(InputError, match=r"robot\.flange_from_cam_mm: .*" + message):
        _mounted(wrong(exact))


def _user_cell(urdf, tool_frame):
    from dataclasses import replace

    return replace(cell(), name="mine", urdf=urdf, tool_frame=tool_frame)
