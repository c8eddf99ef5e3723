"""The robot cell ready for the kernels: chain, capsules, pairs to test, part and obstacles in one value."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError
from netdesign.model.arrays import Floats, Ints
from netdesign.model.frames import transform
from netdesign.model.scene import Part
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import RobotCell
from netdesign.motion.capsules import fit_capsules
from netdesign.motion.collision import FREE, SELF, SKIP, TOUCH, Body, near_box, overlapping, part_field, states
from netdesign.motion.kinematics import restarts
from netdesign.motion.mesh_collision import MeshCell, camera_capsules, learn_pairs, pairs_key
from netdesign.motion.robot import Chain, load_chain
from netdesign.motion.stored import Arrays, content_key, stored
from netdesign.motion.ur_kinematics import UrArm, ur_arm

_SIGHT_BALLS = 8
_VERSION = 6
_SAMPLES = 300
_NEARLY_ALWAYS = 0.8
_OFTEN = 0.02


@dataclass(frozen=True, kw_only=True)
class ArmCell:
    """A loaded cell.

    Attributes:
        chain: the arm as the URDF has it, base frame = the URDF's root.
        placed: the same arm from the world to the camera: world_from_base and flange_from_cam folded in.
        ur: closed form of ``placed``, None for arms built otherwise.
        body: what the collision kernels take.
        loose: capsules too coarse for this arm were left out of its self test: a plan asks the real meshes.
        doubtful: (d, 2) solids whose capsules were left out although they often touch: the search asks their meshes.
        key: SHA-256 of everything that decides whether a configuration is free.
    """

    cell: RobotCell
    chain: Chain
    placed: Chain
    ur: UrArm | None
    body: Body
    loose: bool
    doubtful: Ints
    meshes: MeshCell
    key: str

    @property
    def weights(self) -> Floats:
        """(r,) lambda of the source paper."""
        return np.array(self.cell.joint_weights or np.ones(len(self.chain)), dtype=np.float64)

    def states(self, joints: Floats) -> NDArray[np.int8]:
        """Return the state (n,) of joints (n, r), see ``collision``: by capsules, by meshes where these do not tell."""
        state: NDArray[np.int8] = states(self.body, joints)
        for row in np.flatnonzero(state == FREE) if len(self.doubtful) else ():
            if self.meshes.touches(joints[row], self.doubtful):
                state[row] = SELF
        return state

    @property
    def coaxial(self) -> bool:
        """Whether the camera looks along the last joint axis, so that the last joint is the roll."""
        z, origin = self.placed.last_from_flange[:3, 2], self.placed.last_from_flange[:3, 3]
        return bool(abs(abs(z[2]) - 1.0) < 1e-9 and np.hypot(origin[0], origin[1]) < 1e-6)


def load_arm(cell: RobotCell, sphere: ViewingSphere, part: Part) -> ArmCell:
    """Load the robot and fit its capsules; what takes long is kept on disk by content.

    Raises:
        InputError: see ``load_chain``; or joint_weights of another length than the arm has joints; or a home that is
            not free; or a base inside the part or deep in an obstacle.
    """
    chain = load_chain(cell)
    if cell.joint_weights is not None and len(cell.joint_weights) != len(chain):
        raise InputError(
            f"robot.joint_weights: expected {len(chain)} numbers ({', '.join(chain.joint_names)}), "
            f"found {len(cell.joint_weights)}"
        )
    if cell.joint_weights is not None and not any(cell.joint_weights):
        raise InputError("robot.joint_weights: expected a weight above 0, found none")
    placements = np.array(chain.placements)
    placements[0] = cell.world_from_base @ placements[0]
    last_from_cam = chain.last_from_flange @ cell.flange_from_cam
    base_in_world = tuple(
        replace(shape, vertices=transform(cell.world_from_base, shape.vertices)) if shape.link == 0 else shape
        for shape in chain.shapes
    )
    placed = replace(chain, placements=placements, last_from_flange=last_from_cam, shapes=base_in_world)
    camera = _moved(camera_capsules(cell), chain.last_from_flange)
    boxes = np.concatenate([cell.obstacle_centres, 0.5 * cell.obstacle_sizes], axis=1)
    meshes = MeshCell(placed, camera, part, boxes, cell.margin)
    meshes.pairs = learn_pairs(meshes, placed, pairs_key(chain, camera))
    _check_home(cell, chain, meshes)
    capsules, owner = _capsules(chain)
    capsules[owner_links(chain, owner) == 0] = _moved(capsules[owner_links(chain, owner) == 0], cell.world_from_base)
    capsules = np.concatenate([capsules, camera])
    owner = np.concatenate([owner, len(chain.shapes) + np.arange(len(camera))])
    field, field_origin, field_step = part_field(part)
    reach = float(np.linalg.norm(part.vertices - sphere.centre, axis=1).max())
    share = np.arange(1, _SIGHT_BALLS + 1) / _SIGHT_BALLS
    body = Body(
        placements=placements,
        last_from_cam=last_from_cam,
        capsules=capsules,
        capsule_link=np.array(meshes.links, dtype=np.int64)[owner],
        camera_parts=len(camera),
        pairs=_capsule_pairs(meshes.pairs, owner),
        turn=meshes.first_turn(),
        boxes=boxes,
        mounting=meshes.mounting,
        field=field,
        field_origin=field_origin,
        field_step=field_step,
        margin=cell.margin,
        sight=np.stack([share, share * reach], axis=1),
        centre=np.array(sphere.centre),
    )
    body, loose, doubtful = _without_false_alarms(body, meshes, placed, owner)
    arrays = [np.asarray(value) for value in body]
    return ArmCell(
        cell=cell, chain=chain, placed=placed, ur=ur_arm(placed), body=body, meshes=meshes,
        loose=loose, doubtful=doubtful,
        key=content_key("arm cell", _VERSION, chain.lower, chain.upper, doubtful, *arrays),
    )  # fmt: skip


def _check_home(cell: RobotCell, chain: Chain, meshes: MeshCell) -> None:
    """Raise when the arm cannot stand at home."""
    if cell.home is None:
        return
    if len(cell.home) != len(chain):
        names = ", ".join(chain.joint_names)
        raise InputError(f"robot.home_rad: expected {len(chain)} numbers ({names}), found {len(cell.home)}")
    for name, value, low, high in zip(chain.joint_names, cell.home, chain.lower, chain.upper, strict=True):
        if not low <= value <= high:
            raise InputError(f"robot.home_rad: {name}: expected a value in [{low:g}, {high:g}], found {value:g}")
    contact = meshes.contact(np.array(cell.home))
    if contact:
        raise InputError(f"robot.home_rad: expected joints at which nothing touches, found: {contact}")


def _without_false_alarms(body: Body, meshes: MeshCell, placed: Chain, owner: Ints) -> tuple[Body, bool, Ints]:
    """Return the body without the capsule pairs that overlap in nearly every configuration that is free in truth.

    (The hub of a UR5's upper arm and its base, say: near by construction, and capsules are rounder than links.)
    Likewise of link 2 and what is near the base. Further whether anything was left out, and the pairs of solids (d, 2)
    among it that often do touch. ``owner``: the solid of every capsule.
    """

    def build() -> Arrays:
        drawn = restarts(placed, _SAMPLES, seed=2)
        free = np.array([q for q in drawn if not meshes.touches_itself(q)])
        if not len(free):
            return {"keep": np.ones(len(body.pairs), dtype=np.bool_), "doubtful": np.zeros((0, 2), dtype=np.int64)}
        keep = overlapping(body, free) < _NEARLY_ALWAYS * len(free)
        left_out = np.unique(owner[body.pairs[~keep]].reshape(-1, 2), axis=0)
        often = [np.mean([meshes.touches(q, pair[None]) for q in drawn]) > _OFTEN for pair in left_out]
        return {"keep": keep, "doubtful": left_out[np.array(often, dtype=np.bool_)]}

    kept = stored(content_key("false alarms", _VERSION, body.capsules, body.pairs, body.placements), build)
    keep = kept["keep"]
    mounting, starts = body.mounting.copy(), restarts(placed, _SAMPLES, seed=2)
    for box in meshes.beneath.tolist():
        # Where the capsules are too near at every angle and the meshes are not, these have to say when they are.
        for easier in (TOUCH, SKIP):
            if near_box(body._replace(mounting=mounting), box, starts).all():
                mounting[box] = easier
    loose = not keep.all() or bool((mounting != body.mounting).any())
    return body._replace(pairs=np.ascontiguousarray(body.pairs[keep]), mounting=mounting), loose, kept["doubtful"]


def _moved(capsules: Floats, target_from_source: Floats) -> Floats:
    """Return capsules (k, 7) of one frame expressed in another."""
    return np.concatenate(
        [
            transform(target_from_source, capsules[:, :3]),
            transform(target_from_source, capsules[:, 3:6]),
            capsules[:, 6:],
        ],
        axis=1,
    )


def _capsules(chain: Chain) -> tuple[Floats, Ints]:
    """Return capsules (c, 7) in link frames and the shape (c,) that each covers part of."""

    def build() -> Arrays:
        fitted = [fit_capsules(shape.vertices, shape.faces) for shape in chain.shapes]
        owner = np.repeat(np.arange(len(fitted)), [len(capsules) for capsules in fitted])
        return {"capsules": np.concatenate(fitted), "owner": owner}

    parts = [value for shape in chain.shapes for value in (shape.vertices, shape.faces)]
    arrays = stored(content_key("capsules", _VERSION, *parts), build)
    return arrays["capsules"], arrays["owner"]


def owner_links(chain: Chain, owner: Ints) -> Ints:
    """Return the link (c,) of every capsule from the shape (c,) it covers."""
    return np.array([shape.link for shape in chain.shapes], dtype=np.int64)[owner]


def _capsule_pairs(shape_pairs: Ints, owner: Ints) -> Ints:
    """Return the pairs of capsules (s, 2) of the pairs of shapes."""
    pairs = [
        (first, second)
        for a, b in shape_pairs.tolist()
        for first in np.flatnonzero(owner == a).tolist()
        for second in np.flatnonzero(owner == b).tolist()
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
