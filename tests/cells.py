"""Robot cells for the tests: the default cell of the robot notes, other arms beside a small part."""

import functools

import numpy as np

from netdesign.model.task import RobotCell
from netdesign.motion.catalogue import find_robot, mount
from netdesign.motion.cell import ArmCell, load_arm
from netdesign.motion.joint_map import JointMap
from tests.scenes import box_part, sphere

PART = box_part((0.24, 0.24, 0.20))


def cell(mount_name="side", robot="ur10", base=(-0.6, 0.0, 0.0), tool_frame=None, **changes):
    """A robot on a pedestal beside a table whose top lies 0.1 m below the centre of the part."""
    urdf, package_dirs, flange = find_robot(robot)
    world_from_base = np.eye(4)
    world_from_base[:3, 3] = base
    pedestal = [base[0], base[1], base[2] - 0.305]
    return RobotCell(
        name=robot, urdf=urdf, package_dirs=package_dirs, tool_frame=tool_frame or flange,
        world_from_base=world_from_base, flange_from_cam=mount(mount_name),
        obstacle_centres=[[0, 0, -0.11], pedestal], obstacle_sizes=[[0.9, 0.9, 0.02], [0.2, 0.2, 0.6]], **changes,
    )  # fmt: skip


@functools.cache
def arm(mount_name="side", robot="ur10") -> ArmCell:
    return load_arm(cell(mount_name, robot), sphere(), PART)


@functools.cache
def joint_map(mount_name="side", roll=0.0, elevation=(10, 90)) -> JointMap:
    """The map of the default cell, read from the disk cache after the first time."""
    return JointMap.of_arm(arm(mount_name), sphere(roll=roll, elevation=elevation))


def viewpoints(count, seed, elevation_deg=(10, 90)):
    """Equal-area random viewpoints (count, 2)."""
    rng = np.random.default_rng(seed)
    low, high = np.sin(np.radians(elevation_deg))
    return np.stack([rng.uniform(-np.pi, np.pi, count), np.arcsin(rng.uniform(low, high, count))], axis=1)


def reachable_viewpoints(of_map, count, seed):
    """``count`` random viewpoints that the map calls free."""
    drawn = viewpoints(20 * count, seed)
    return drawn[of_map.reachable(drawn)][:count]
