"""The final word on collisions: coal on the real meshes.

Self pairs are those that touch in some sampled configurations and not in nearly all: neighbours always touch, and a
pair that never does in thousands of samples is left out of the capsule test too, where it may give false alarms.
"""

import itertools
from dataclasses import dataclass

import coal
import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.frames import pose
from netdesign.model.scene import Part
from netdesign.model.task import RobotCell
from netdesign.motion.collision import FREE, KEEP, OBSTACLE, SELF, TOUCH, TURN_STEPS
from netdesign.motion.collision import PART as STATE_PART
from netdesign.motion.kinematics import link_poses, restarts
from netdesign.motion.robot import Chain
from netdesign.motion.stored import Arrays, content_key, stored

_SAMPLES = 3000
_NEARLY_ALWAYS = 0.95
_BRACKET_RADIUS = 0.02
_ANGLES = (181, 31)  # of the first two joints, over which it is found out what the base stands on
_SPARE = 2e-3  # m: link 1 moves less between two steps of its turn
PART = "the part"


def camera_capsules(cell: RobotCell) -> Floats:
    """Return the camera's body and its bracket as capsules (2, 7) m in the flange frame."""
    body = np.array([[0.0, 0.0, -cell.camera_radius], [0.0, 0.0, -max(cell.camera_length - cell.camera_radius, 0.0)]])
    ends = body @ cell.flange_from_cam[:3, :3].T + cell.flange_from_cam[:3, 3]
    bracket = np.concatenate([np.zeros(3), ends.mean(axis=0), [min(_BRACKET_RADIUS, cell.camera_radius)]])
    return np.stack([np.concatenate([ends.ravel(), [cell.camera_radius]]), bracket])


@dataclass(frozen=True)
class _Solid:
    """A coal object that moves with a link."""

    name: str
    link: int
    link_from_solid: Floats
    item: coal.CollisionObject


class MeshCell:
    """The arm, its camera, the part and the obstacles as coal objects.

    Args:
        chain: in the world frame (``ArmCell.placed``); camera: capsules (k, 7) in the last link's frame.
        part: None without one.
        boxes: (b, 6) centre and half edges in the world.
        margin: m kept from part and boxes.

    Raises:
        InputError: the base stands in the part, or so deep in a box that the first joint cannot turn.
    """

    def __init__(self, chain: Chain, camera: Floats, part: Part | None, boxes: Floats, margin: float) -> None:
        self._placements = np.array(chain.placements)
        self._links = np.empty((len(chain), 3, 4))
        self._solids = [
            _Solid(shape.name, shape.link, np.eye(4), coal.CollisionObject(_mesh(shape.vertices, shape.faces)))
            for shape in chain.shapes
        ]
        self._solids += [_capsule("camera", len(chain), capsule) for capsule in camera]
        self._around = [] if part is None else [(PART, coal.CollisionObject(_mesh(part.vertices, part.faces)))]
        for index, box in enumerate(boxes):
            item = coal.CollisionObject(coal.Box(*(2.0 * box[3:])))
            item.setTranslation(box[:3])
            self._around.append((f"obstacle {index + 1}", item))
        for _, item in self._around:
            item.computeAABB()
        self.pairs: Ints = np.zeros((0, 2), dtype=np.int64)
        self._touch = coal.CollisionRequest(coal.CollisionRequestFlag.NO_REQUEST, 1)
        self._near = coal.CollisionRequest(coal.CollisionRequestFlag.NO_REQUEST, 1)
        self._near.security_margin = margin
        self._mounting = self._stood_on(chain, part)

    def place(self, q: Floats) -> None:
        """Move every solid to joints q (r,)."""
        link_poses(self._placements, np.ascontiguousarray(q, dtype=np.float64), self._links)
        for solid in self._solids:
            base_from_solid = solid.link_from_solid[:3]
            if solid.link:
                link = self._links[solid.link - 1]
                base_from_solid = link[:, :3] @ base_from_solid
                base_from_solid[:, 3] += link[:, 3]
            solid.item.setTransform(coal.Transform3s(base_from_solid[:, :3], base_from_solid[:, 3]))

    def _stood_on(self, chain: Chain, part: Part | None) -> dict[str, tuple[int, int]]:
        """Return how links 1 and 2 are tested against what is near the base: KEEP, TOUCH or SKIP, see ``Body``.

        A link that is within the margin of it at every angle of its joints, as the base is, cannot keep the margin: the
        base stands on it. A thing from which the link can turn away is an obstacle like any other.
        """
        q = np.clip(np.zeros(len(chain)), chain.lower, chain.upper)
        self.place(q)
        beneath = [around for around in self._around if self._hits(0, around[1], self._near)]
        if part is not None and (
            self._hits(0, self._around[0][1], self._touch)
            or any(_encloses(part, shape.vertices[0]) for shape in chain.shapes if shape.link == 0)
        ):
            raise InputError(
                "robot.base_position_mm: expected a base outside of the part (mm, world frame), found one that reaches"
                " into it"
            )
        last = np.minimum(chain.upper[:2], chain.lower[:2] + 2.0 * np.pi)
        first, second = (np.linspace(chain.lower[joint], last[joint], _ANGLES[joint]) for joint in (0, 1))
        ways: dict[str, tuple[int, int]] = {}
        for name, item in beneath:
            near, touching, far = [], [], False
            for q[0] in first:
                self.place(q)
                near.append(self._hits(1, item, self._near))
                touching.append(self._hits(1, item, self._touch))
            if all(touching):
                raise InputError(
                    f"robot.obstacles: expected room for the first joint to turn, found {name} (counted from 1) around"
                    " the base, so high that the first moving link touches it at every angle"
                )
            for q[0], q[1] in itertools.product(first[::6], second):
                self.place(q)
                far = not self._hits(2, item, self._near)
                if far:
                    break
            ways[name] = (TOUCH if all(near) else KEEP, KEEP if far else TOUCH)
        return ways

    def first_turn(self) -> NDArray[np.int8]:
        """Return what link 1 touches (_TURN_STEPS,) as its joint turns: FREE, PART or OBSTACLE, 2 mm to spare.

        No other joint moves it, and its shape often is nothing like a capsule.
        """
        spare = {}
        for way, request in ((KEEP, self._near), (TOUCH, self._touch)):
            spare[way] = coal.CollisionRequest(coal.CollisionRequestFlag.NO_REQUEST, 1)
            spare[way].security_margin = request.security_margin + _SPARE
        q, turn = np.zeros(len(self._links)), np.full(TURN_STEPS, FREE, dtype=np.int8)
        for step in range(TURN_STEPS):
            q[0] = 2.0 * np.pi * step / TURN_STEPS
            self.place(q)
            for name, item in self._around:
                if self._hits(1, item, spare[self._mounting.get(name, (KEEP, KEEP))[0]]):
                    turn[step] = STATE_PART if name == PART else OBSTACLE
                    break
        return turn

    def _hits(self, link: int, item: coal.CollisionObject, request: coal.CollisionRequest) -> bool:
        """Return whether a solid of a link touches or comes near an object."""
        return any(
            coal.collide(solid.item, item, request, coal.CollisionResult())
            for solid in self._solids
            if solid.link == link
        )

    def touching(self, first: int, second: int) -> bool:
        """Return whether two solids of the arm touch where they stand now."""
        result = coal.CollisionResult()
        return bool(coal.collide(self._solids[first].item, self._solids[second].item, self._touch, result))

    def contact(self, q: Floats) -> str:
        """Return what touches what at joints q (r,), "" when nothing does (margin to part and obstacles included)."""
        self.place(q)
        for solid in self._solids:
            if solid.link == 0:
                continue
            for name, item in self._around:
                request = self._near
                if solid.link <= 2 and name in self._mounting and self._mounting[name][solid.link - 1] != KEEP:
                    request = self._touch
                if coal.collide(solid.item, item, request, coal.CollisionResult()):
                    return f"{solid.name} touches {name}"
        for first, second in self.pairs.tolist():
            if self.touching(first, second):
                return f"{self._solids[first].name} touches {self._solids[second].name}"
        return ""

    def leg_contact(self, start: Floats, end: Floats, step: float) -> str:
        """Return the first contact on the straight joint line from start to end (r,), tested every ``step`` rad."""
        count = max(int(np.ceil(np.abs(end - start).max() / step)), 1)
        for share in np.linspace(0.0, 1.0, count + 1):
            found = self.contact(start + share * (end - start))
            if found:
                return found
        return ""

    def touches_itself(self, q: Floats) -> bool:
        """Return whether the arm touches itself at joints q (r,)."""
        return self.touches(q, self.pairs)

    def touches(self, q: Floats, pairs: Ints) -> bool:
        """Return whether any of some pairs of solids (s, 2) touch at joints q (r,)."""
        self.place(q)
        return any(self.touching(first, second) for first, second in pairs.tolist())

    def state(self, q: Floats) -> int:
        """Return FREE, PART, OBSTACLE or SELF at joints q (r,)."""
        found = self.contact(q)
        if not found:
            return FREE
        return STATE_PART if found.endswith(PART) else OBSTACLE if " touches obstacle " in found else SELF

    @property
    def mounting(self) -> Ints:
        """(b,) how link 2 is tested against every obstacle, see ``Body``."""
        ways = [self._mounting.get(name, (KEEP, KEEP))[1] for name, _ in self._around if name != PART]
        return np.array(ways, dtype=np.int64)

    @property
    def beneath(self) -> Ints:
        """The obstacles that are within the margin of the base."""
        names = [name for name, _ in self._around if name != PART]
        return np.array([row for row, name in enumerate(names) if name in self._mounting], dtype=np.int64)

    @property
    def links(self) -> list[int]:
        """The link of every solid, 0 the base."""
        return [solid.link for solid in self._solids]


def learn_pairs(meshes: MeshCell, chain: Chain, key: str) -> Ints:
    """Return the pairs of solids (s, 2) that can touch: sampled with the real meshes, seeded, kept on disk.

    Neighbouring links are left out, and so are solids on the same link.
    """

    def build() -> Arrays:
        links = np.array(meshes.links)
        candidates = [
            (a, b) for a in range(len(links)) for b in range(a + 1, len(links)) if abs(int(links[a] - links[b])) > 1
        ]
        hits = np.zeros(len(candidates))
        for q in restarts(chain, _SAMPLES, seed=1):
            meshes.place(q)
            hits += [meshes.touching(a, b) for a, b in candidates]
        kept: Bools = (hits > 0) & (hits < _NEARLY_ALWAYS * _SAMPLES)
        return {"pairs": np.array(candidates, dtype=np.int64).reshape(-1, 2)[kept]}

    return stored(key, build)["pairs"]


def pairs_key(chain: Chain, camera: Floats) -> str:
    """Return the content key of everything that decides which parts of the arm can touch."""
    shapes = [value for shape in chain.shapes for value in (shape.vertices, shape.faces, shape.link)]
    return content_key("self pairs 1", chain.placements[1:], chain.lower, chain.upper, camera, *shapes)


def _encloses(part: Part, point: Floats) -> bool:
    """Return whether a point (3,) lies inside a closed part: the solid angles of its triangles make up a sphere.

    Source: A. Van Oosterom, J. Strackee, IEEE Trans. Biomed. Eng. 30, 1983.
    """
    a, b, c = np.moveaxis(part.triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    spread = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return bool(abs(np.arctan2(volume, spread).sum()) > 1.99 * np.pi)


def _mesh(vertices: Floats, faces: Ints) -> coal.BVHModelOBBRSS:
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(np.ascontiguousarray(vertices, dtype=np.float64))
    model.addTriangles(np.ascontiguousarray(faces))
    model.endModel()
    return model


def _capsule(name: str, link: int, capsule: Floats) -> _Solid:
    start, end = capsule[:3], capsule[3:6]
    length = float(np.linalg.norm(end - start))
    z = (end - start) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x = x / np.linalg.norm(x)
    placement = pose(np.stack([x, np.cross(z, x), z], axis=1), 0.5 * (start + end))
    return _Solid(name, link, placement, coal.CollisionObject(coal.Capsule(float(capsule[6]), length)))
