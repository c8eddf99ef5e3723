"""What the robot is to do for one network: waypoints, stops, times; and the cell as meshes for pictures."""

import itertools
from dataclasses import dataclass

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Bools, Floats, Ints, frozen
from netdesign.model.frames import inverse, transform
from netdesign.model.scene import Part
from netdesign.motion.cell import ArmCell
from netdesign.motion.joint_map import JointMap
from netdesign.motion.kinematics import link_poses
from netdesign.motion.legs import Legs
from netdesign.motion.timing import leg_law

# The sampled trajectory stays this far inside speed and acceleration, for the rounding of its numbers.
_HEADROOM = 1e-4
PART_COLOUR = (205, 170, 110)


@dataclass(frozen=True, kw_only=True)
class Program:
    """The motion of one network.

    Attributes:
        waypoints: (w, r) rad, stations and via points in order, home first and last where the cell has one.
        station: (w,) number of the station in visiting order, -1 for a via point and for home.
        base_from_cam: (w, 4, 4) m, base = the URDF's root.  controller_from_cam: the same in the controller's base.
    """

    arm: ArmCell
    waypoints: Floats
    station: Ints
    base_from_cam: Floats
    controller_from_cam: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "waypoints", frozen("waypoints", self.waypoints, ("w", len(self.arm.chain))))

    def leg_times(self) -> Floats:
        """Return the duration (w - 1,) of every leg in s."""
        chain = self.arm.chain
        pairs = itertools.pairwise(self.waypoints)
        return np.array([leg_law(a, b, chain.speed, chain.acceleration).duration for a, b in pairs])


def program_of(joint_map: JointMap, joints: Floats, planned: dict[int, Floats] | None = None) -> Program:
    """Return the program over joints (n, r) in visiting order, from home and back; legs that collide get via points.

    Args:
        planned: via points of the design by number of the leg; they are what its tour was measured over.

    Raises:
        InfeasibleError: a leg for which no free way is found.
    """
    arm = joint_map.arm
    legs, planned = Legs(joint_map), planned or {}
    home = [] if arm.cell.home is None else [(-1, np.array(arm.cell.home))]
    stops = [*home, *enumerate(joints), *home]
    waypoints, station = [stops[0][1]], [stops[0][0]]
    for leg, ((left, start), (number, end)) in enumerate(itertools.pairwise(stops), start=1):
        vias = planned.get(left, np.zeros((0, len(arm.chain)))) if 0 <= left < number else np.zeros((0, len(arm.chain)))
        contact = _contact(legs, [start, *vias, end])
        if contact:
            detour = legs.detour(start, end)
            if detour is None:
                raise InfeasibleError(f"leg {leg}: no free way: {contact}")
            vias = detour
        waypoints += list(vias)
        station += [-1] * len(vias)
        waypoints.append(end)
        station.append(number)
    path = np.array(waypoints)
    world_from_cam = camera_poses(arm, path)
    base_from_cam = inverse(arm.cell.world_from_base) @ world_from_cam
    return Program(
        arm=arm,
        waypoints=path,
        station=np.array(station, dtype=np.int64),
        base_from_cam=base_from_cam,
        controller_from_cam=arm.chain.controller_from_base @ base_from_cam,
    )


def _contact(legs: Legs, way: list[Floats]) -> str:
    """Return what is touched first on straight lines from point to point, "" when they are free."""
    return next((contact for pair in itertools.pairwise(way) if (contact := legs.contact(*pair))), "")


def camera_poses(arm: ArmCell, joints: Floats) -> Floats:
    """Return world_from_cam (n, 4, 4) of joints (n, r)."""
    return link_world_poses(arm, joints)[:, -1] @ arm.placed.last_from_flange


def link_world_poses(arm: ArmCell, joints: Floats) -> Floats:
    """Return world_from_link (n, r, 4, 4) of the moving links at joints (n, r)."""
    poses = np.zeros((len(joints), len(arm.chain), 4, 4))
    poses[..., 3, 3] = 1.0
    for q, links in zip(np.ascontiguousarray(joints, dtype=np.float64), poses, strict=True):
        link_poses(arm.body.placements, q, links[:, :3])
    return poses


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A program over time.

    Attributes:
        time_ns: (k,) from the start, increasing.  joints: (k, r) rad.  velocity: (k, r) rad/s.
        stop: (k,) whether the arm stands at a station there.
    """

    time_ns: Ints
    joints: Floats
    velocity: Floats
    stop: Bools


def sampled(program: Program, rate: float = 25.0) -> Trajectory:
    """Return the program sampled at least ``rate`` times per second, with a sample wherever the acceleration changes.

    Between samples the speed is linear, so that a cubic through joints and velocities is the motion itself: a
    controller that interpolates cubically keeps the limits. (Only end points with zero speed would not: the cubic
    through them exceeds the acceleration by half.) The dwell is a repeated point.
    """
    arm = program.arm
    speed, acceleration = arm.chain.speed * (1.0 - _HEADROOM), arm.chain.acceleration * (1.0 - _HEADROOM)
    times, joints, velocity, stop = (
        [0],
        [program.waypoints[0]],
        [np.zeros(len(arm.chain))],
        [bool(program.station[0] >= 0)],
    )
    clock = 0

    def rest(duration: float) -> None:
        nonlocal clock
        if duration > 0.0:
            clock += round(duration * 1e9)
            times.append(clock)
            joints.append(joints[-1])
            velocity.append(np.zeros(len(arm.chain)))
            stop.append(True)

    if program.station[0] >= 0:
        rest(arm.cell.dwell)
    for index in range(1, len(program.waypoints)):
        start, end = program.waypoints[index - 1], program.waypoints[index]
        law = leg_law(start, end, speed, acceleration)
        if law.duration > 0.0:
            marks = [0.0, law.ramp, law.duration - law.ramp, law.duration]
            phases = [
                np.linspace(a, b, max(int(np.ceil((b - a) * rate)), 1) + 1)[1:]
                for a, b in itertools.pairwise(marks)
                if b - a > 1e-6
            ]
            ticks = np.unique(np.rint(np.concatenate(phases) * 1e9).astype(np.int64))
            local: Floats = ticks.astype(np.float64) * 1e-9
            local[-1] = law.duration
            times += (clock + ticks).tolist()
            joints += list(start + law.share(local)[:, None] * (end - start))
            velocity += list(law.rate(local)[:, None] * (end - start))
            stop += [False] * (len(ticks) - 1) + [bool(program.station[index] >= 0)]
            joints[-1], velocity[-1] = end, np.zeros(len(arm.chain))
            clock += int(ticks[-1])
        if program.station[index] >= 0:
            rest(arm.cell.dwell)
    return Trajectory(
        time_ns=np.array(times, dtype=np.int64),
        joints=np.array(joints),
        velocity=np.array(velocity),
        stop=np.array(stop, dtype=np.bool_),
    )


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A coloured mesh in the world: vertices (v, 3) m, faces (t, 3), red green blue 0 to 255."""

    name: str
    vertices: Floats
    faces: Ints
    colour: tuple[int, int, int]


def cell_geometry(arm: ArmCell, part: Part | None, joints: Floats) -> tuple[Solid, ...]:
    """Return the cell with the arm at joints (r,): links, camera, part and obstacles."""
    links = [np.eye(4), *link_world_poses(arm, joints[None])[0]]
    solids = [
        Solid(
            name=shape.name,
            vertices=transform(links[shape.link], shape.vertices),
            faces=shape.faces,
            colour=(150, 160, 175),
        )
        for shape in arm.placed.shapes
    ]
    half = np.array([arm.cell.camera_radius, arm.cell.camera_radius, 0.5 * arm.cell.camera_length])
    camera = camera_poses(arm, joints[None])[0]
    body, faces = _box(np.array([0.0, 0.0, -half[2]]), half)
    solids.append(Solid(name="camera", vertices=transform(camera, body), faces=faces, colour=(40, 40, 45)))
    if part is not None:
        solids.append(Solid(name="part", vertices=part.vertices, faces=part.faces, colour=PART_COLOUR))
    for index, box in enumerate(arm.body.boxes):
        corners, faces = _box(box[:3], box[3:])
        solids.append(Solid(name=f"obstacle_{index + 1}", vertices=corners, faces=faces, colour=(190, 190, 185)))
    return tuple(solids)


def _box(centre: Floats, half: Floats) -> tuple[Floats, Ints]:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return centre + half * signs, np.array(faces, dtype=np.int64)
