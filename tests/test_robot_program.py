"""Robot programs: what is written keeps the limits, meets the design, and touches nothing."""

import csv
import itertools
import json
import re

import numpy as np
import pytest
import trimesh
import yaml
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from netdesign.files.robot_program import cell_glb, joint_trajectory_yaml, stations_csv, urscript
from netdesign.files.stations import parse_stations, stations_table
from netdesign.motion.plan import plan_on
from netdesign.motion.program import camera_poses, cell_geometry, program_of, sampled
from tests.cells import PART, joint_map, reachable_viewpoints

# Universal Robots' published DH parameters of the UR10, mm as in example-robot-data's URDF: d1, a2, a3, d4, d5, d6.
D1, A2, A3, D4, D5, D6 = 0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922


@pytest.fixture(scope="module")
def planned():
    of_map = joint_map()
    plan = plan_on(of_map, reachable_viewpoints(of_map, 8, 21))
    return of_map, plan, program_of(of_map, plan.tour.joints)


def controller_flange(q):
    """Forward kinematics by Denavit and Hartenberg, in the frame UR's controller calls base."""
    half = np.pi / 2
    rows = [(0, half, D1), (A2, 0, 0), (A3, 0, 0), (0, half, D4), (0, -half, D5), (0, 0, D6)]
    pose = np.eye(4)
    for (a, alpha, d), angle in zip(rows, q, strict=True):
        ct, st, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array(
            [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return pose


def test_a_program_goes_over_the_via_points_of_the_design_unless_they_touch_something():
    of_map = joint_map()
    start = np.array([0.89, -1.67, 2.60, -0.32, 1.44, 1.65])
    end = np.array([-0.97, -0.55, 1.58, -2.70, 1.38, -0.48])
    found = program_of(of_map, np.array([start, end]))
    assert found.station.tolist() == [0, *[-1] * (len(found.waypoints) - 2), 1]
    planned = np.insert(found.waypoints[1:-1], 1, found.waypoints[1:3].mean(axis=0), axis=0)
    program = program_of(of_map, np.array([start, end]), {0: planned})
    np.testing.assert_array_equal(program.waypoints, [start, *planned, end])
    touching = program_of(of_map, np.array([start, end]), {0: 0.5 * (start + end)[None]})
    np.testing.assert_array_equal(touching.waypoints, found.waypoints)


def test_urscript_poses_against_the_controllers_own_kinematics(planned):
    _, plan, program = planned
    text = urscript(program, 3)
    assert text.startswith("def netdesign_network_3():")
    tcp = np.array([float(v) for v in re.search(r"set_tcp\(p\[(.*?)\]\)", text)[1].split(",")])
    tool = np.eye(4)
    tool[:3, 3], tool[:3, :3] = tcp[:3], Rotation.from_rotvec(tcp[3:]).as_matrix()
    poses = [[float(v) for v in found.split(",")] for found in re.findall(r"tcp p\[(.*?)\]", text)]
    moves = [[float(v) for v in found.split(",")] for found in re.findall(r"movej\(\[(.*?)\]", text)]
    assert len(moves) == len(program.waypoints) == len(poses)
    for joints, pose in zip(moves, poses, strict=True):
        expected = controller_flange(joints) @ tool
        np.testing.assert_allclose(expected[:3, 3], pose[:3], atol=1e-6)
        np.testing.assert_allclose(expected[:3, :3], Rotation.from_rotvec(pose[3:]).as_matrix(), atol=1e-6)
    assert text.count("sleep(0.500)") == len(plan.tour.joints)


def test_ros2_trajectory_driven_by_a_cubic_controller(planned):
    of_map, plan, program = planned
    arm = of_map.arm
    message = yaml.safe_load(joint_trajectory_yaml(program, sampled(program)))
    assert message["joint_names"] == list(arm.chain.joint_names)
    time = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]])
    joints = np.array([p["positions"] for p in message["points"]])
    velocity = np.array([p["velocities"] for p in message["points"]])
    assert (np.diff(time) > 0).all()
    spline = CubicHermiteSpline(time, joints, velocity)
    fine = np.unique(np.concatenate([np.linspace(time[0], time[-1], 20000), time + 1e-6, time[1:] - 1e-6]))
    fine = fine[fine <= time[-1]]
    assert (np.abs(spline(fine, 1)).max(axis=0) <= arm.chain.speed).all()
    assert (np.abs(spline(fine, 2)).max(axis=0) <= arm.chain.acceleration).all()
    driven = spline(fine)
    assert (driven >= arm.chain.lower).all()
    assert (driven <= arm.chain.upper).all()
    # Every station is stood at, in order, for the dwell.
    still = [np.flatnonzero(np.abs(joints - q).max(axis=1) < 1e-9) for q in plan.tour.joints]
    assert all(time[rows[-1]] - time[rows[0]] >= 0.5 - 1e-9 for rows in still)
    assert all(a[-1] < b[0] for a, b in itertools.pairwise(still))
    poses = camera_poses(arm, joints[[rows[0] for rows in still]])
    np.testing.assert_allclose(poses, plan.world_from_cam, atol=1e-9)
    # Dense sampling on the real meshes, the whole way.
    assert not any(arm.meshes.contact(q) for q in spline(np.linspace(time[0], time[-1], 1500)))
    total = program.leg_times().sum() + 0.5 * len(plan.tour.joints)
    assert time[-1] == pytest.approx(total, rel=1e-3)


def test_end_points_alone_would_exceed_the_acceleration(planned):
    """Why the trajectory is sampled: the cubic through rest and rest takes 1.5 times the limit."""
    _, _, program = planned
    leg = program.leg_times()[0]
    change = np.abs(program.waypoints[1] - program.waypoints[0]).max()
    cruise = change / 1.05 > 1.05 / 1.4
    peak = 6 * change / leg**2
    assert cruise or peak == pytest.approx(1.5 * 1.4, rel=1e-6)


def test_csv_has_a_row_per_station(planned):
    _, plan, program = planned
    text = stations_csv(plan.viewpoints, plan.world_from_cam, plan.tour.joints, program.arm.chain.joint_names)
    rows = [line.split(",") for line in text.splitlines()]
    assert rows[0][:4] == ["order", "alpha_deg", "beta_deg", "shoulder_pan_joint_rad"]
    values = np.array(rows[1:], dtype=float)
    np.testing.assert_allclose(values[:, 3:9], plan.tour.joints, rtol=0, atol=0)
    np.testing.assert_allclose(values[:, 9:12], plan.world_from_cam[:, :3, 3] * 1e3, rtol=1e-12)
    np.testing.assert_allclose(
        Rotation.from_quat(values[:, 12:]).as_matrix(), plan.world_from_cam[:, :3, :3], atol=1e-12
    )


def test_csv_has_the_via_points_behind_the_station_they_leave(planned, tmp_path):
    _, plan, program = planned
    names, joints = program.arm.chain.joint_names, plan.tour.joints
    straight = list(csv.reader(stations_csv(plan.viewpoints, plan.world_from_cam, joints, names).splitlines()))
    vias = {2: joints[2:4] + 0.125, 5: joints[5:6] / 3}
    text = stations_csv(plan.viewpoints, plan.world_from_cam, joints, names, vias)
    rows = list(csv.reader(text.splitlines()))
    assert [row[:-1] for row in rows] == straight
    assert rows[0][-1] == "vias_to_next_rad"
    for number, row in enumerate(rows[1:]):
        points = [[float(value) for value in point.split()] for point in row[-1].split("|") if point.strip()]
        np.testing.assert_array_equal(np.reshape(points, (-1, 6)), vias.get(number, np.zeros((0, 6))))
    (tmp_path / "s.csv").write_text(text)
    poses = parse_stations(stations_table("s.csv", tmp_path), tmp_path / "s.csv")
    np.testing.assert_allclose(poses, plan.world_from_cam, atol=1e-12)


def test_glb_holds_the_cell(planned):
    of_map, plan, _ = planned
    solids = cell_geometry(of_map.arm, PART, plan.tour.joints[0])
    data = cell_glb(solids, plan.world_from_cam, (0.34, 0.28))
    scene = trimesh.load(trimesh.util.wrap_as_stream(data), file_type="glb")
    names = set(scene.geometry)
    assert {"part", "camera", "obstacle_1", "upper_arm_link_0", "station_7"} <= names
    # y is up in glTF: the part's extent along world z is its extent along y there.
    np.testing.assert_allclose(scene.geometry["part"].extents, [0.24, 0.20, 0.24], atol=1e-6)
    camera = next(solid for solid in solids if solid.name == "camera")
    front = camera.vertices[np.abs(camera.vertices - plan.world_from_cam[0, :3, 3]).max(axis=1) < 0.05]
    assert len(front) == 4


def test_json_record_is_plain(planned):
    from types import SimpleNamespace

    from netdesign.files.robot_program import program_record
    from netdesign.files.store import plain

    _, plan, program = planned
    record = plain(program_record(program, SimpleNamespace(study=SimpleNamespace(name="a"))))
    assert json.loads(json.dumps(record))["waypoints"][0]["station"] == 0
    assert record["duration_s"] == pytest.approx(program.leg_times().sum() + 4.0)
    np.testing.assert_allclose(np.array(record["waypoints"][2]["joints_rad"]), program.waypoints[2], atol=0)
    assert len(plan.tour.joints) == 8
