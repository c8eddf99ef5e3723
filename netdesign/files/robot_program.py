"""Robot programs as files: JSON, CSV, URScript, ROS 2 JointTrajectory, and the cell as GLB.

Poses of the camera's perspective centre are given in the world and, as the tool centre point, in the base frame that
the robot's controller uses (ROS-Industrial's "base"; for Universal Robots turned half a turn from base_link).
"""

import csv
import io
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from netdesign.model.arrays import Floats
from netdesign.model.frames import pose, quaternion_xyzw, transform
from netdesign.model.task import Task
from netdesign.motion.program import Program, Solid, Trajectory

MM = 1e-3
_FRUSTUM = 0.06  # m, depth of the camera pyramids in the cell model


def stations_csv(
    viewpoints: Floats,
    world_from_cam: Floats,
    joints: Floats | None,
    names: Sequence[str],
    vias: Mapping[int, Floats] = MappingProxyType({}),
) -> str:
    """Return one row per station: order, viewpoint, joints, camera position in mm and quaternion x, y, z, w.

    A tour with via points has one more column, vias_to_next_rad: the joints to drive over on the way to the next row,
    a space between joints, a bar between points, empty where the straight joint line is free.

    Args:
        viewpoints: (n, 2) rad.  world_from_cam: (n, 4, 4) m.  joints: (n, r) rad, or None.  names: of the joints.
        vias: (k, r) rad by number of the leg; leg i leaves station i.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{name}_rad" for name in names] if joints is not None else []
    more = ["vias_to_next_rad"] if vias else []
    writer.writerow(["order", "alpha_deg", "beta_deg", *columns, "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw", *more])
    quaternions = quaternion_xyzw(world_from_cam[:, :3, :3])
    for index in range(len(viewpoints)):
        values = [
            *np.degrees(viewpoints[index]),
            *([] if joints is None else joints[index]),
            *(world_from_cam[index, :3, 3] / MM),
            *quaternions[index],
        ]
        row = [index, *(repr(float(value)) for value in values)]
        if vias:
            row.append(" | ".join(" ".join(repr(float(value)) for value in via) for via in vias.get(index, ())))
        writer.writerow(row)
    return text.getvalue()


def program_record(program: Program, task: Task) -> dict[str, Any]:
    """Return the content of the JSON program: the cell's frames, waypoints and times."""
    chain, cell = program.arm.chain, program.arm.cell
    times = program.leg_times()
    waypoints = [
        {
            "station": None if station < 0 else int(station),
            "joints_rad": q,
            "base_from_cam_mm": _mm(base),
            "tcp_in_controller_base": _ur_pose(tcp),
            "leg_s": 0.0 if index == 0 else float(times[index - 1]),
        }
        for index, (q, station, base, tcp) in enumerate(
            zip(program.waypoints, program.station, program.base_from_cam, program.controller_from_cam, strict=True)
        )
    ]
    return {
        "robot": chain.name,
        "joint_names": list(chain.joint_names),
        "world_from_base_mm": _mm(cell.world_from_base),
        "controller_from_base_mm": _mm(chain.controller_from_base),
        "flange_from_cam_mm": _mm(cell.flange_from_cam),
        "limits": {
            "lower_rad": chain.lower,
            "upper_rad": chain.upper,
            "speed_rad_s": chain.speed,
            "acceleration_rad_s2": chain.acceleration,
        },
        "dwell_s": cell.dwell,
        "duration_s": float(times.sum() + cell.dwell * (program.station >= 0).sum()),
        "waypoints": waypoints,
        "study": task.study.name,
    }


def urscript(program: Program, network: int) -> str:
    """Return a URScript program: movej to every waypoint, a pause and a pulse on digital output 0 at every station.

    movej runs its leading axis with a trapezoid of the given speed and acceleration and the others along with it,
    which is the motion that was planned.
    """
    chain, cell = program.arm.chain, program.arm.cell
    flange = cell.flange_from_cam
    lines = [
        f"def netdesign_network_{network}():",
        f"  # Joints in rad. Drive to {'the first station' if cell.home is None else 'home'} by hand first: "
        "the way there has not been tested.",
        f"  set_tcp(p[{_numbers([*flange[:3, 3], *Rotation.from_matrix(flange[:3, :3]).as_rotvec()])}])",
    ]
    previous = program.waypoints[0]
    for index, (q, station, tcp) in enumerate(
        zip(program.waypoints, program.station, program.controller_from_cam, strict=True)
    ):
        # A via point never is the first or the last of a program.
        rest = "home" if index in (0, len(program.waypoints) - 1) else "via point"
        moved = np.abs(q - previous) > 1e-9
        speed = float(chain.speed[moved].min()) if moved.any() else float(chain.speed.min())
        acceleration = float(chain.acceleration.min())
        lines.append(f"  # {rest if station < 0 else f'station {station}'}: tcp p[{_numbers(_ur_pose(tcp))}]")
        lines.append(f"  movej([{_numbers(q)}], a={acceleration:.6f}, v={speed:.6f})")
        if station >= 0:
            lines.append(f"  sleep({cell.dwell:.3f})")
            lines.append("  set_standard_digital_out(0, True)")
            lines.append("  sync()")
            lines.append("  set_standard_digital_out(0, False)")
        previous = q
    return "\n".join([*lines, "end", ""])


def joint_trajectory_yaml(program: Program, trajectory: Trajectory) -> str:
    """Return a trajectory_msgs/JointTrajectory message, sampled so that a cubic controller keeps all limits."""
    lines = ["header:", "  stamp: {sec: 0, nanosec: 0}", "  frame_id: ''", "joint_names:"]
    lines += [f"- {name}" for name in program.arm.chain.joint_names]
    lines.append("points:")
    for time, q, velocity in zip(trajectory.time_ns.tolist(), trajectory.joints, trajectory.velocity, strict=True):
        seconds, nanoseconds = divmod(time, 1_000_000_000)
        lines.append(f"- positions: [{_numbers(q)}]")
        lines.append(f"  velocities: [{_numbers(velocity)}]")
        lines.append("  accelerations: []")
        lines.append("  effort: []")
        lines.append(f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}")
    return "\n".join([*lines, ""])


def cell_glb(solids: Sequence[Solid], world_from_cam: Floats, field_of_view: tuple[float, float]) -> bytes:
    """Return a binary glTF of the cell and a pyramid for each station; lengths in m, y up as glTF wants it.

    Args:
        field_of_view: half width and half height of the image at unit depth.
    """
    y_up = pose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
    scene = trimesh.Scene()
    for solid in solids:
        _add(scene, solid.name, transform(y_up, solid.vertices), solid.faces, solid.colour)
    x, y = np.array(field_of_view) * _FRUSTUM
    corners = np.array([[0, 0, 0], [-x, -y, _FRUSTUM], [x, -y, _FRUSTUM], [x, y, _FRUSTUM], [-x, y, _FRUSTUM]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]])
    for index, camera in enumerate(world_from_cam):
        _add(scene, f"station_{index}", transform(y_up @ camera, corners), faces, (70, 110, 200))
    return bytes(scene.export(file_type="glb"))


def _add(scene: trimesh.Scene, name: str, vertices: Floats, faces: Any, colour: tuple[int, int, int]) -> None:
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[*colour, 255], metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    scene.add_geometry(mesh, node_name=name, geom_name=name)


def _mm(a_from_b: Floats) -> Floats:
    scaled = np.array(a_from_b)
    scaled[..., :3, 3] /= MM
    return scaled


def _ur_pose(a_from_b: Floats) -> list[float]:
    """Return Universal Robots' pose: position in m and rotation vector in rad."""
    return [*a_from_b[:3, 3].tolist(), *Rotation.from_matrix(a_from_b[:3, :3]).as_rotvec().tolist()]


def _numbers(values: Any) -> str:
    return ", ".join(f"{float(value):.12g}" for value in values)
