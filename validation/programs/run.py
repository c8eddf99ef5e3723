"""Drives the exported robot programs of a run through the real meshes: python validation/programs/run.py RUN.

Each network's ROS 2 trajectory is read back and interpolated by cubics as a controller does it, its URScript movej by
movej as straight joint lines; both are sampled densely. coal tests every sample on the meshes of arm, camera, part and
obstacles, the margin of the study included; pinocchio's forward kinematics gives the camera's pose at every stop, which
is compared with the design. Writes results-NAME.json beside this file and renews the table in validation/README.md.
"""

import argparse
import itertools
import json
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin
import yaml
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from netdesign.export import export
from netdesign.files.design_json import read_networks
from netdesign.motion.joint_map import JointMap
from netdesign.run_folder import open_run

HERE = Path(__file__).parent
BEGIN, END = "<!-- programs -->\n", "<!-- end of programs -->\n"
RATE = 200.0  # Hz, of the samples of a trajectory
STEP = 0.01  # rad, of the samples of a movej
POSITION_M = ROTATION_RAD = 1e-6  # what a stop may be off the design


class Flange:
    """The camera's pose by pinocchio, from the URDF itself."""

    def __init__(self, arm) -> None:
        self.arm = arm
        self.model = pin.buildModelFromUrdf(str(arm.cell.urdf))
        self.data = self.model.createData()
        self.frame = self.model.getFrameId(arm.cell.tool_frame or "tool0")

    def camera(self, joints):
        """Return world_from_cam (4, 4) at joints (r,)."""
        q = pin.neutral(self.model)
        values = dict(self.arm.cell.lock) | dict(zip(self.arm.chain.joint_names, joints.tolist(), strict=True))
        for name, value in values.items():
            joint = self.model.joints[self.model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        pin.framesForwardKinematics(self.model, self.data, q)
        base_from_flange = self.data.oMf[self.frame].homogeneous
        return self.arm.cell.world_from_base @ base_from_flange @ self.arm.cell.flange_from_cam


def trajectory(path):
    """Return times (k,) s, joints (k, r), velocities (k, r) and the stops (n, r) of a JointTrajectory."""
    message = yaml.load(path.read_text(), Loader=yaml.CSafeLoader)
    points = message["points"]
    time = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points])
    joints, velocity = (np.array([p[key] for p in points]) for key in ("positions", "velocities"))
    rests = np.flatnonzero((joints[1:] == joints[:-1]).all(axis=1) & (velocity[1:] == 0.0).all(axis=1))
    return time, joints, velocity, joints[rests]


def script(path):
    """Return the targets (w, r) of a URScript, its (a, v) rows (w, 2), and which targets (w,) are stopped at."""
    text = path.read_text()
    moves = re.findall(r"movej\(\[(.*?)\], a=([\d.]+), v=([\d.]+)\)\n(  sleep)?", text)
    targets = np.array([[float(value) for value in joints.split(",")] for joints, *_ in moves])
    return targets, np.array([[float(a), float(v)] for _, a, v, _ in moves]), np.array([bool(s) for *_, s in moves])


def off_the_design(flange, stops, planned):
    """Return the largest error of position in m and of rotation in rad over the stops; their number must be right."""
    if len(stops) != len(planned):
        raise RuntimeError(f"expected {len(planned)} stops, found {len(stops)}")
    poses = np.array([flange.camera(q) for q in stops])
    turn = Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1) @ planned[:, :3, :3]).magnitude()
    return float(np.linalg.norm(poses[:, :3, 3] - planned[:, :3, 3], axis=1).max()), float(turn.max())


def drive(arm, flange, run, network, folder):
    """Return what was measured on both programs of one network."""
    chain = arm.chain
    time, joints, velocity, stops = trajectory(export(run, network.id, "ros2", folder / "tour.yaml"))
    spline = CubicHermiteSpline(time, joints, velocity)
    fine = np.arange(0.0, time[-1], 1.0 / RATE)
    # The acceleration of a cubic is linear between its points: its extremes are beside them.
    edges = np.concatenate([time[:-1] + 1e-7, time[1:] - 1e-7])
    samples = [spline(fine)]
    targets, settings, stopped = script(export(run, network.id, "urscript", folder / "tour.script"))
    for start, end in itertools.pairwise(targets):
        count = max(int(np.ceil(np.abs(end - start).max() / STEP)), 1)
        samples.append(start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start))
    driven = np.concatenate(samples)
    planned = network.world_from_cam
    errors = [off_the_design(flange, found, planned) for found in (stops, targets[stopped])]
    return {
        "network": network.id,
        "stops": len(planned),
        "duration_s": float(time[-1]),
        "samples": len(driven),
        "contacts": [found for found in map(arm.meshes.contact, driven) if found],
        "outside_limits": int(((driven < chain.lower) | (driven > chain.upper)).any(axis=1).sum()),
        "speed_share": float((np.abs(spline(np.concatenate([fine, edges]), 1)) / chain.speed).max()),
        "acceleration_share": float((np.abs(spline(edges, 2)) / chain.acceleration).max()),
        "movej_share": float((settings / [chain.acceleration.min(), chain.speed.max()]).max()),
        "position_error_m": max(position for position, _ in errors),
        "rotation_error_rad": max(rotation for _, rotation in errors),
    }


def row(result):
    """Return the run's line of the table."""
    networks = result["networks"]
    worst = {key: max(entry[key] for entry in networks) for key in networks[0] if key not in ("contacts", "network")}
    contacts = sum(len(entry["contacts"]) for entry in networks)
    samples = sum(entry["samples"] for entry in networks)
    kept = not contacts and not worst["outside_limits"]
    kept &= worst["speed_share"] <= 1.0 and worst["acceleration_share"] <= 1.0 and worst["movej_share"] <= 1.0 + 1e-9
    kept &= worst["position_error_m"] <= POSITION_M and worst["rotation_error_rad"] <= ROTATION_RAD
    return (
        f"| {result['study']} | {len(networks)} | {samples} | {contacts} | {worst['outside_limits']} "
        f"| {worst['speed_share']:.5f} | {worst['acceleration_share']:.5f} | {worst['position_error_m']:.1e} "
        f"| {worst['rotation_error_rad']:.1e} | {'holds' if kept else '**fails**'} |"
    )


def table():
    """Write the table of all results into README.md."""
    lines = [
        "| run | networks | samples | contacts | outside the limits | peak speed / limit | peak acceleration / limit "
        "| position at stops [m] | rotation at stops [rad] | result |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [row(json.loads(path.read_text())) for path in sorted(HERE.glob("results-*.json"))]
    path = HERE.parent / "README.md"
    text = path.read_text(encoding="utf-8")
    head, tail = text.split(BEGIN)[0], text.split(END)[1]
    path.write_text(head + BEGIN + "\n".join(lines) + "\n" + END + tail, encoding="utf-8")


def main() -> None:
    """Drive the programs of one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    task = open_run(options.run)
    if task.cell is None:
        sys.exit(f"{options.run}: expected a run with a robot")
    arm = JointMap.build(task.cell, task.sphere, task.scene.part).arm
    flange = Flange(arm)
    result = {"study": task.study.name, "study_sha256": task.sha256, "networks": []}
    with tempfile.TemporaryDirectory() as folder:
        for network in read_networks(options.run).values():
            result["networks"].append(drive(arm, flange, options.run, network, Path(folder)))
            print(json.dumps(result["networks"][-1]), flush=True)
    out = HERE / f"results-{task.study.name}.json"
    out.write_text(json.dumps(result, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    table()
    print(row(result))


if __name__ == "__main__":
    main()
