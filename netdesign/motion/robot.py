"""The only file that meets pinocchio: a URDF becomes plain arrays.

A ``Chain`` is the path of revolute joints from the robot's root to the frame that carries the camera. Every link frame
is turned so that its joint rotates about its own z axis, so that the kernels need one kind of joint only:

    base_from_flange = placements[0] Rz(q0) placements[1] Rz(q1) … placements[r-1] Rz(q[r-1]) last_from_flange
"""

import os
import re
import tempfile
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
import pinocchio as pin

from netdesign.errors import InputError
from netdesign.model.arrays import Bools, Floats, Ints, frozen
from netdesign.model.frames import inverse, pose, skew
from netdesign.model.task import RobotCell
from netdesign.motion.shapes import triangles
from netdesign.motion.urdf import prepared_urdf

# ROS-Industrial's names (REP 199).
_STANDARD_FLANGES = ("tool0", "flange")
_NAMED = 12  # frames or joints that a message names
# A continuous joint may turn for ever, its cables may not: one and a half turns to either side.
_CONTINUOUS_LIMIT = 3.0 * np.pi
_TURN = 2.0 * np.pi
_MOST_TURNED = 4.0 * _TURN  # of a limit in a study: beyond it stand degrees


@dataclass(frozen=True, kw_only=True)
class LinkShape:
    """The collision mesh of a link.

    Attributes:
        link: 0 for the base, i + 1 for the link that joint i moves.
        vertices: (v, 3) m in that link's frame of the ``Chain``.  faces: (t, 3).
    """

    name: str
    link: int
    vertices: Floats
    faces: Ints


@dataclass(frozen=True, kw_only=True)
class Chain:
    """A serial arm of r revolute joints, each about the z axis of its own link frame.

    Attributes:
        placements: (r, 4, 4) m, previous link frame from this link's frame at joint value 0.
        last_from_flange: (4, 4) m.
        lower, upper: (r,) rad; a continuous joint has ±3 pi.
        wraps: (r,) whether the joint can stand at one angle in more than one turn.
        speed, acceleration: (r,) rad/s and rad/s², already the smaller of URDF and study.
        controller_from_base: (4, 4), the frame called "base" (ROS-Industrial: what the controller calls its base)
            from the URDF's root.
        shapes: collision meshes; a gripper behind or beside the flange is left out, the camera stands in its place.
    """

    name: str
    joint_names: tuple[str, ...]
    placements: Floats
    last_from_flange: Floats
    lower: Floats
    upper: Floats
    wraps: Bools
    speed: Floats
    acceleration: Floats
    controller_from_base: Floats
    shapes: tuple[LinkShape, ...]

    def __post_init__(self) -> None:
        count = len(self.joint_names)
        object.__setattr__(self, "placements", frozen("placements", self.placements, (count, 4, 4)))
        object.__setattr__(self, "last_from_flange", frozen("last_from_flange", self.last_from_flange, (4, 4)))
        for name in ("lower", "upper", "speed", "acceleration"):
            object.__setattr__(self, name, frozen(name, getattr(self, name), (count,)))
        object.__setattr__(self, "wraps", frozen("wraps", self.wraps, (count,), np.bool_))

    def __len__(self) -> int:
        return len(self.joint_names)


def load_chain(cell: RobotCell) -> Chain:
    """Read the URDF of the cell: locked joints become rigid, joints that do not move the flange stay at rest.

    Raises:
        InputError: no such file, not a URDF, a missing mesh, an unknown frame or joint, a joint that does not rotate.
    """
    model, geometry = _loaded(cell)
    model, geometry, tool = _reduce(model, geometry, _tool_frame(model, cell), cell)
    joints = list(range(1, model.njoints))
    _check_serial(model, cell)
    # `turned[i]`: the joint's own frame in pinocchio from our link frame, whose z is the joint axis.
    turned = [np.eye(4)] + [pose(_z_to(_axis(model, joint)), np.zeros(3)) for joint in joints]
    placements = [
        inverse(turned[joint - 1]) @ model.jointPlacements[joint].homogeneous @ turned[joint] for joint in joints
    ]
    names = tuple(model.names[joint] for joint in joints)
    lower, upper = _limits(model, names, cell)
    urdf_speed = np.where(model.velocityLimit > 0, model.velocityLimit, np.inf)
    frame = model.frames[tool]
    base = model.frames[model.getFrameId("base") if model.existFrame("base") else 0]
    base_from_controller = base.placement.homogeneous if base.parentJoint == 0 else np.eye(4)
    return Chain(
        name=cell.name,
        joint_names=names,
        placements=np.array(placements),
        last_from_flange=inverse(turned[frame.parentJoint]) @ frame.placement.homogeneous,
        lower=lower,
        upper=upper,
        wraps=upper - lower > _TURN + 1e-6,
        speed=np.minimum(urdf_speed, cell.speed),
        acceleration=np.full(len(names), cell.acceleration),
        controller_from_base=inverse(base_from_controller),
        shapes=_shapes(model, geometry, tool, turned),
    )


def _loaded(cell: RobotCell) -> tuple[Any, Any]:
    """Return pinocchio's model and collision geometry."""
    text = prepared_urdf(cell.urdf, cell.package_dirs, cell.limits)
    complaints = tempfile.TemporaryFile()
    stderr = os.dup(2)
    os.dup2(complaints.fileno(), 2)  # urdfdom says there, in C++, what is wrong
    try:
        model = pin.buildModelFromXML(text)
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    except ValueError as error:
        complaints.seek(0)
        found = re.findall(r"Error: *(.+)", complaints.read().decode(errors="replace"))
        reason = found[0] if found else " ".join(str(error).split())
        raise InputError(f"robot.urdf: {cell.urdf.name}: {reason}") from None
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        complaints.close()
    if not geometry.geometryObjects:
        raise InputError(
            f"robot.urdf: {cell.urdf.name}: expected collision geometry (meshes, boxes, cylinders, spheres), found none"
        )
    return model, geometry


def _tool_frame(model: Any, cell: RobotCell) -> str:
    """Return the name of the frame that carries the camera."""
    names = [frame.name for frame in model.frames if frame.type != pin.FrameType.JOINT]
    wanted = cell.tool_frame or next((name for name in _STANDARD_FLANGES if name in names), None)
    if wanted is None:
        raise InputError(f"robot.tool_frame: expected the frame that carries the camera, one of {_few(names, names)}")
    if wanted not in names:
        near = get_close_matches(wanted, names, n=_NAMED, cutoff=0.4)
        hint = f" (nearest: {', '.join(near[:3])})" if near else ""
        raise InputError(f"robot.tool_frame: expected one of {_few(names, near)}; found {wanted!r}{hint}")
    return wanted


def _few(names: list[str], first: list[str]) -> str:
    """Return names for a message: all when they are few, else some, those that are asked for and then the last."""
    if len(names) <= _NAMED:
        return ", ".join(names)
    chosen = list(dict.fromkeys([*first[:_NAMED], *names[::-1]]))[:_NAMED]
    return f"{', '.join(chosen)} and {len(names) - _NAMED} more"


def _reduce(model: Any, geometry: Any, tool: str, cell: RobotCell) -> tuple[Any, Any, int]:
    """Return model and geometry with every joint locked that is locked by the study or does not move the flange."""
    moving = set(model.supports[model.frames[model.getFrameId(tool)].parentJoint].tolist())
    known = list(model.names)[1:]
    rest = pin.neutral(model)
    for name, value in cell.lock.items():
        if name not in known:
            raise InputError(
                f"robot.lock: expected one of {_few(known, get_close_matches(name, known))}; found {name!r}"
            )
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 1:
            low, high = float(model.lowerPositionLimit[joint.idx_q]), float(model.upperPositionLimit[joint.idx_q])
            if low < high and not low <= value <= high:
                unit = "m" if joint.shortname().startswith("JointModelP") else "rad"
                raise InputError(f"robot.lock.{name}: expected {low:g} to {high:g} {unit}, found {value:g}")
        rest[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    locked = [index for index in range(1, model.njoints) if index not in moving or model.names[index] in cell.lock]
    reduced, (shapes,) = pin.buildReducedModel(model, [geometry], locked, rest)
    if reduced.njoints < 2:
        raise InputError(f"robot.tool_frame: expected a frame that joints move, found {tool!r} fixed to the base")
    return reduced, shapes, reduced.getFrameId(tool)


def _check_serial(model: Any, cell: RobotCell) -> None:
    for index in range(1, model.njoints):
        kind = model.joints[index].shortname()
        if model.joints[index].nv != 1 or "JointModelR" not in kind:
            found = "a prismatic one" if kind.startswith("JointModelP") else kind.removeprefix("JointModel")
            raise InputError(
                f"robot.urdf: {cell.urdf.name}: joint {model.names[index]}: expected a revolute or continuous joint, "
                f"found {found}; lock it"
            )
    if not 6 <= model.nv <= 7:
        names = ", ".join(list(model.names)[1:])
        advice = "; lock some (robot.lock)" if model.nv > 7 else ": too few to reach a pose"
        raise InputError(
            f"robot.urdf: {cell.urdf.name}: expected 6 or 7 joints that move the camera, "
            f"found {model.nv} ({names}){advice}"
        )


def _axis(model: Any, joint: int) -> Floats:
    """Return the joint axis (3,) in the joint's own frame: the local Jacobian's rotational part."""
    data = model.createData()
    column = model.joints[joint].idx_v
    jacobian = pin.computeJointJacobian(model, data, pin.neutral(model), joint)
    return np.asarray(jacobian[3:, column])


def _z_to(axis: Floats) -> Floats:
    """Return the smallest rotation (3, 3) that takes z to a unit axis."""
    if axis[2] < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = skew(np.cross([0.0, 0.0, 1.0], axis))
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + axis[2]))


def _limits(model: Any, names: tuple[str, ...], cell: RobotCell) -> tuple[Floats, Floats]:
    lower, upper = np.empty(len(names)), np.empty(len(names))
    for index, name in enumerate(names):
        joint = model.joints[index + 1]
        continuous = joint.nq == 2
        low, high = (
            (-_CONTINUOUS_LIMIT, _CONTINUOUS_LIMIT)
            if continuous
            else (model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q])
        )
        low, high = cell.limits.get(name, (low, high))
        if name in cell.limits and max(abs(low), abs(high)) > _MOST_TURNED:
            raise InputError(
                f"robot.limits_rad.{name}: expected radians, no more than four turns to either side, found"
                f" [{low:g}, {high:g}]"
            )
        if not (np.isfinite([low, high]).all() and low < high):
            source = "" if name in cell.limits else f" in {cell.urdf.name}; set robot.limits_rad"
            raise InputError(f"robot.limits_rad.{name}: expected low < high, found [{low:g}, {high:g}]{source}")
        lower[index], upper[index] = low, high
    unknown = sorted(set(cell.limits) - set(names))
    if unknown:
        raise InputError(f"robot.limits_rad: expected one of {', '.join(names)}; found {unknown[0]!r}")
    return lower, upper


def _shapes(model: Any, geometry: Any, tool: int, turned: list[Floats]) -> tuple[LinkShape, ...]:
    """Return the collision meshes in our link frames, without what hangs behind or beside the flange."""
    ancestors, frame = {0}, tool
    while frame not in ancestors:
        ancestors.add(frame)
        frame = model.frames[frame].parentFrame
    last = model.njoints - 1
    shapes = []
    for item in geometry.geometryObjects:
        if item.parentJoint == last and item.parentFrame not in ancestors:
            continue
        vertices, faces = triangles(item.geometry, item.name)
        link_from_shape = inverse(turned[item.parentJoint]) @ item.placement.homogeneous
        moved = vertices @ link_from_shape[:3, :3].T + link_from_shape[:3, 3]
        shapes.append(LinkShape(name=item.name, link=item.parentJoint, vertices=moved, faces=faces))
    return tuple(shapes)
