"""The URDF becomes a chain: forward kinematics as pinocchio has it, clear errors, locked joints, renamed frames."""

import numpy as np
import pinocchio as pin
import pytest

from netdesign.errors import InputError
from netdesign.motion.kinematics import base_from_flange, restarts
from netdesign.motion.robot import find_robot, load_chain, mount
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
    for q, pose in zip(joints, base_from_flange(chain, joints), strict=True):
        np.testing.assert_allclose(pose, pinocchio_flange(urdf, flange, chain.joint_names, q), rtol=0, atol=1e-12)


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


def _user_cell(urdf, tool_frame):
    from dataclasses import replace

    return replace(cell(), name="mine", urdf=urdf, tool_frame=tool_frame)
