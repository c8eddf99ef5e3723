"""The [robot] table: from names and paths to a RobotCell, and a user's URDF packed into the run directory."""

from pathlib import Path

import numpy as np

from netdesign.errors import InputError
from netdesign.files.packages import resolve_path, share_folder
from netdesign.model.arrays import Floats
from netdesign.model.frames import pose, rotation_from_rpy
from netdesign.model.study import RobotTable
from netdesign.model.task import RobotCell
from netdesign.motion.catalogue import find_robot, mount
from netdesign.motion.urdf import bundled_urdf

MM = 1e-3
_ROUNDED = 2e-3  # how far a rotation written with three digits may be from one


def resolve_cell(table: RobotTable, folder: Path) -> RobotCell:
    """Return the robot cell in SI units.

    Args:
        table: the [robot] table.  folder: where its relative paths start.

    Raises:
        InputError: unknown robot name, missing URDF, or a flange_from_cam_mm that is not a rigid transform.
    """
    if table.name is not None:
        name, (urdf, package_dirs, tool_frame) = table.name, find_robot(table.name)
    else:
        urdf = _urdf(table, folder)
        name, tool_frame = urdf.stem, None
        package_dirs = (*(resolve_path(entry, folder) for entry in table.package_dirs), share_folder())
    flange_from_cam = mount(table.camera_mount)
    if table.flange_from_cam_mm is not None:
        flange_from_cam = _rigid(np.array(table.flange_from_cam_mm, dtype=np.float64))
    boxes = table.obstacles
    return RobotCell(
        name=name,
        urdf=urdf,
        package_dirs=tuple(package_dirs),
        tool_frame=table.tool_frame or tool_frame,
        world_from_base=pose(
            rotation_from_rpy(np.radians(table.base_rotation_deg)), np.array(table.base_position_mm) * MM
        ),
        flange_from_cam=flange_from_cam,
        lock=dict(table.lock),
        limits={joint: (low, high) for joint, (low, high) in table.limits_rad.items()},
        joint_weights=table.joint_weights,
        speed=table.speed_rad_s,
        acceleration=table.acceleration_rad_s2,
        dwell=table.dwell_s,
        margin=table.margin_mm * MM,
        obstacle_centres=np.array([box.position_mm for box in boxes]).reshape(-1, 3) * MM,
        obstacle_sizes=np.array([box.box_mm for box in boxes]).reshape(-1, 3) * MM,
        home=table.home_rad,
        repeatability=(table.repeatability_mm * MM, table.repeatability_mrad * MM),
    )


def bundle_robot(table: RobotTable, folder: Path) -> tuple[RobotTable, dict[str, bytes]]:
    """Return the table with paths into inputs/robot, and the files to put there; a robot by name needs none.

    A camera mount with few digits is written as the rotation that is used.

    Raises:
        InputError: the URDF or a mesh that it names is missing, or the camera mount is none.
    """
    if table.flange_from_cam_mm is not None:
        given = np.array(table.flange_from_cam_mm, dtype=np.float64)
        used = _rigid(given)
        used[:3, 3] = given[:3, 3]
        if np.abs(used - given).max() > 1e-12:
            table = table.model_copy(update={"flange_from_cam_mm": tuple(map(tuple, used.tolist()))})
    if table.urdf is None:
        return table, {}
    urdf = _urdf(table, folder)
    packages = tuple(resolve_path(entry, folder) for entry in table.package_dirs)
    text, meshes = bundled_urdf(urdf, (*packages, share_folder()), share_folder())
    files = {"inputs/robot/robot.urdf": text.encode()}
    files |= {f"inputs/robot/{name}": mesh.read_bytes() for name, mesh in meshes.items()}
    return table.model_copy(update={"urdf": "inputs/robot/robot.urdf", "package_dirs": ()}), files


def _urdf(table: RobotTable, folder: Path) -> Path:
    urdf = resolve_path(str(table.urdf), folder)
    if urdf.is_dir():
        raise InputError(f"{urdf}: expected a URDF file, found a folder (robot.urdf)")
    if not urdf.is_file():
        raise InputError(f"{urdf}: no such file (robot.urdf)")
    return urdf


def _rigid(matrix: Floats) -> Floats:
    """Return a 4x4 transform in mm as metres; a rotation given with few digits becomes the nearest one.

    Raises:
        InputError: the last row is another one, or the upper left 3x3 is no right-handed rotation.
    """
    key = "robot.flange_from_cam_mm"
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        hint = "; is the matrix transposed?" if np.allclose(matrix[:, 3], [0, 0, 0, 1]) else ""
        raise InputError(f"{key}: expected a last row [0, 0, 0, 1], found {matrix[3].tolist()}{hint}")
    left, stretch, right = np.linalg.svd(matrix[:3, :3])
    handed = float(np.linalg.det(left @ right))
    if np.abs(stretch - 1.0).max() > _ROUNDED or handed < 0:
        raise InputError(
            f"{key}: expected a right-handed rotation in the upper left 3x3, found singular values "
            f"{', '.join(f'{value:.4g}' for value in stretch)} and determinant {np.linalg.det(matrix[:3, :3]):.3g}"
        )
    return pose(left @ right, matrix[:3, 3] * MM)
