"""Does the arm touch anything, or block its own view? Capsules against capsules, boxes and the part, compiled.

Everything is conservative: capsules contain the link meshes and the part's distance field never exceeds the true
distance, so a configuration that passes here is free; ``mesh_collision`` has the final word on one that does not.

A segment is tested against a body whose distance function d is known by walking along it: from a point at distance d
the next d - radius metres cannot touch, since a distance changes by no more than the way walked.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry, part
from netdesign.model.scene import Part
from netdesign.motion.kinematics import flange_of, link_poses

FREE, NO_SOLUTION, LIMITS, SELF, PART, OBSTACLE, SIGHT = range(7)
REASONS = (
    "free",
    "out of reach",
    "joint limits",
    "the robot touches itself",
    "the robot touches the part",
    "the robot touches an obstacle",
    "the robot blocks the view",
)
KEEP, TOUCH, SKIP = range(3)
TURN_STEPS = 360
_FIELD_CELLS = 96
_FIELD_PAD = 0.10
_SHORTEST_STEP = 5e-4
_NOWHERE = 1e3  # m: no arm reaches so far
_AT_ONCE = 32  # configurations of a leg


class Body(NamedTuple):
    """The arm in its cell as arrays for the kernels; metres, world frame unless said otherwise.

    placements (r, 4, 4) and last_from_cam (4, 4): the chain from the world to the camera.
    capsules (c, 7) in the frame of capsule_link (c,), 0 the base: both ends and the radius; the last `camera_parts` of
    them belong to the camera. pairs (s, 2): capsules that are tested against each other.
    turn (TURN_STEPS,): state of link 1, which no capsules are asked for, over one turn of its joint from 0.
    boxes (b, 6): centre and half edge lengths; mounting (b,): whether link 2 must KEEP the margin to them, is only
    tested for TOUCH, because the base stands on it and it is near at every angle, or SKIPs it: the meshes have to say.
    field (x, y, z): lower bound of the distance to the part at the centre of each cell; field_origin (3,): centre of
    cell 0; field_step: edge of a cell.
    margin: kept from part and obstacles. sight (k, 2): share of the line of sight, as long as the centre is far, and
    the radius that must be clear there, never more than half of the way; centre (3,) of the stations.
    """

    placements: Floats
    last_from_cam: Floats
    capsules: Floats
    capsule_link: Ints
    camera_parts: int
    pairs: Ints
    turn: NDArray[np.int8]
    boxes: Floats
    mounting: Ints
    field: Floats
    field_origin: Floats
    field_step: float
    margin: float
    sight: Floats
    centre: Floats


def part_field(part: Part) -> tuple[Floats, Floats, float]:
    """Return (field (x, y, z) m, centre of cell 0 (3,) m, edge of a cell m): a lower bound of the distance to the part.

    The surface is sampled no coarser than half a cell and the distance taken between cell centres, so the true distance
    can be smaller by half a cell's diagonal at either end, and by a third of a cell between samples; that is taken
    off. The inside of a closed part has distance 0.
    """
    corners = part.triangles
    low, high = corners.min(axis=(0, 1)) - _FIELD_PAD, corners.max(axis=(0, 1)) + _FIELD_PAD
    step = float((high - low).max() / _FIELD_CELLS)
    shape = np.ceil((high - low) / step).astype(np.int64) + 1
    occupied = np.zeros(shape, dtype=np.bool_)
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    longest = np.linalg.norm(np.concatenate([edges, edges[:, :1] - edges[:, 1:]], axis=1), axis=2).max(axis=1)
    divisions = np.maximum(np.ceil(longest / (0.5 * step)).astype(np.int64), 1)
    for count in np.unique(divisions):
        chosen = divisions == count
        a, b = np.nonzero(np.add.outer(np.arange(count + 1), np.arange(count + 1)) <= count)
        weights = np.stack([a, b], axis=1) / count
        points = (corners[chosen, :1] + np.einsum("sk,tkx->tsx", weights, edges[chosen])).reshape(-1, 3)
        index = np.rint((points - low) / step).astype(np.int64)
        occupied[tuple(index.T)] = True
    filled = ndimage.binary_fill_holes(occupied)
    distance = ndimage.distance_transform_edt(~filled) * step
    error = (math.sqrt(3.0) + 1.0 / 3.0) * step
    field = np.maximum(distance - error, 0.0)
    field[filled] = 0.0
    return np.ascontiguousarray(field, dtype=np.float64), low, step


@part()
def _segment_segment(p, q):  # type: ignore[no-untyped-def]
    """Return the squared distance of the segments p[0:3]–p[3:6] and q[0:3]–q[3:6].

    Source of the clamping: C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    ax, ay, az = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    bx, by, bz = q[3] - q[0], q[4] - q[1], q[5] - q[2]
    cx, cy, cz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    aa, bb = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz
    ab = ax * bx + ay * by + az * bz
    ac, bc = ax * cx + ay * cy + az * cz, bx * cx + by * cy + bz * cz
    determinant = aa * bb - ab * ab
    s = 0.0
    if aa > 1e-18 and determinant > 1e-14 * aa * bb:
        s = min(max((ab * bc - ac * bb) / determinant, 0.0), 1.0)
    t = (ab * s + bc) / bb if bb > 1e-18 else 0.0
    t = min(max(t, 0.0), 1.0)
    if aa > 1e-18:
        s = min(max((ab * t - ac) / aa, 0.0), 1.0)
    dx, dy, dz = cx + ax * s - bx * t, cy + ay * s - by * t, cz + az * s - bz * t
    return dx * dx + dy * dy + dz * dz


@part()
def _box_distance(box, x, y, z):  # type: ignore[no-untyped-def]
    dx = max(abs(x - box[0]) - box[3], 0.0)
    dy = max(abs(y - box[1]) - box[4], 0.0)
    dz = max(abs(z - box[2]) - box[5], 0.0)
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@part()
def _field_distance(field, origin, step, x, y, z):  # type: ignore[no-untyped-def]
    """Return a lower bound of the distance to the part: the field inside it, the way to it and its pad outside."""
    outside = 0.0
    index = np.empty(3, dtype=np.int64)
    position = (x, y, z)
    for a in range(3):
        cell = (position[a] - origin[a]) / step
        last = field.shape[a] - 1
        beyond = max(-cell, cell - last, 0.0)
        outside += (beyond * step) ** 2
        index[a] = math.floor(min(max(cell, 0.0), float(last)) + 0.5)
    if outside > 0.0:
        return math.sqrt(outside) + 0.5 * _FIELD_PAD
    return field[index[0], index[1], index[2]]


@part()
def touches_box(p, radius, box):  # type: ignore[no-untyped-def]
    """Return whether a point of the segment p (6,) is nearer than ``radius`` to a box (centre, half edges)."""
    dx, dy, dz = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    walked = 0.0
    while True:
        share = walked / length if length > 0.0 else 0.0
        gap = _box_distance(box, p[0] + share * dx, p[1] + share * dy, p[2] + share * dz) - radius
        if gap < 0.0:
            return True
        if walked >= length:
            return False
        walked = min(walked + max(gap, _SHORTEST_STEP), length)


@part()
def touches_field(p, radius, field, origin, step):  # type: ignore[no-untyped-def]
    """Return whether a point of the segment p (6,) may be nearer than ``radius`` to the part."""
    dx, dy, dz = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    walked = 0.0
    while True:
        share = walked / length if length > 0.0 else 0.0
        gap = _field_distance(field, origin, step, p[0] + share * dx, p[1] + share * dy, p[2] + share * dz) - radius
        if gap < 0.0:
            return True
        if walked >= length:
            return False
        walked = min(walked + max(gap, _SHORTEST_STEP), length)


@part()
def _place(body, q, links, placed):  # type: ignore[no-untyped-def]
    """Write world_from_link into links (r, 3, 4) and the capsules' ends in the world into placed (c, 6)."""
    link_poses(body.placements, q, links)
    for c in range(body.capsules.shape[0]):
        link = body.capsule_link[c]
        for end in range(2):
            x, y, z = body.capsules[c, 3 * end], body.capsules[c, 3 * end + 1], body.capsules[c, 3 * end + 2]
            for a in range(3):
                if link == 0:
                    placed[c, 3 * end + a] = body.capsules[c, 3 * end + a]
                else:
                    m = links[link - 1]
                    placed[c, 3 * end + a] = m[a, 0] * x + m[a, 1] * y + m[a, 2] * z + m[a, 3]


@part()
def configuration_state(body, q, links, placed):  # type: ignore[no-untyped-def]
    """Return FREE, SELF, PART, OBSTACLE or SIGHT for joints q (r,).

    links (r, 3, 4) and placed (c, 6) are scratch: world_from_link and the capsules' ends in the world.
    """
    r, count = q.shape[0], body.capsules.shape[0]
    step = math.floor(q[0] * (TURN_STEPS / (2.0 * math.pi)))
    for at in range(step, step + 2):
        if body.turn[at % TURN_STEPS] != FREE:
            return body.turn[at % TURN_STEPS]
    _place(body, q, links, placed)
    for c in range(count):
        if body.capsule_link[c] <= 1:
            continue
        radius = body.capsules[c, 6] + body.margin
        if touches_field(placed[c], radius, body.field, body.field_origin, body.field_step):
            return PART
        for b in range(body.boxes.shape[0]):
            way = body.mounting[b] if body.capsule_link[c] == 2 else KEEP
            if way == SKIP:
                continue
            near = radius if way == KEEP else body.capsules[c, 6]
            if touches_box(placed[c], near, body.boxes[b]):
                return OBSTACLE
    for s in range(body.pairs.shape[0]):
        first, second = body.pairs[s, 0], body.pairs[s, 1]
        radius = body.capsules[first, 6] + body.capsules[second, 6]
        if _segment_segment(placed[first], placed[second]) < radius * radius:
            return SELF
    camera = np.empty((3, 4))
    flange_of(links[r - 1], body.last_from_cam, camera)
    ball, far = np.empty(6), 0.0
    for a in range(3):
        far += (body.centre[a] - camera[a, 3]) ** 2
    far = math.sqrt(far)
    for k in range(body.sight.shape[0]):
        way = body.sight[k, 0] * far
        for a in range(3):
            ball[a] = camera[a, 3] + way * camera[a, 2]
            ball[a + 3] = ball[a]
        for c in range(count - body.camera_parts):
            radius = body.capsules[c, 6] + min(body.sight[k, 1], 0.5 * way)
            if _segment_segment(placed[c], ball) < radius * radius:
                return SIGHT
    return FREE


@entry()
def states(body, joints):  # type: ignore[no-untyped-def]
    """Return the state (n,) int8 of joints (n, r)."""
    n, r = joints.shape
    links, placed = np.empty((r, 3, 4)), np.empty((body.capsules.shape[0], 6))
    out = np.empty(n, dtype=np.int8)
    for i in range(n):
        out[i] = configuration_state(body, joints[i], links, placed)
    return out


def alone(body: Body) -> Body:
    """Return the body with nothing around it and nothing to look at."""
    return body._replace(
        turn=np.zeros_like(body.turn), boxes=body.boxes[:0], mounting=body.mounting[:0], sight=body.sight[:0],
        field=np.full((2, 2, 2), np.inf), field_origin=np.full(3, -_NOWHERE), field_step=2.0 * _NOWHERE,
    )  # fmt: skip


def near_box(body: Body, box: int, joints: Floats) -> Bools:
    """Return in which of joints (n, r) the capsules of link 2 come too near to a box, see ``Body.mounting``."""
    own = body.capsule_link == 2
    by_itself = alone(body)._replace(
        capsules=np.ascontiguousarray(body.capsules[own]), capsule_link=body.capsule_link[own], camera_parts=0,
        pairs=body.pairs[:0], boxes=body.boxes[box : box + 1], mounting=body.mounting[box : box + 1],
    )  # fmt: skip
    return np.asarray(states(by_itself, joints) == OBSTACLE)


def overlapping(body: Body, joints: Floats) -> Ints:
    """Return in how many of joints (n, r) each of the body's pairs (s,) overlaps."""
    by_itself = alone(body)
    pairs = (body.pairs[s : s + 1] for s in range(len(body.pairs)))
    return np.array([(states(by_itself._replace(pairs=pair), joints) == SELF).sum() for pair in pairs], dtype=np.int64)


def leg_state(body: Body, start: Floats, end: Floats, step: float) -> int:
    """Return the first state that is not FREE on the straight joint line, ends included; the view may be blocked.

    Joints (r,); ``step`` rad is the largest change of any joint between two tests.
    """
    count = math.ceil(np.abs(end - start).max() / step) + 1
    for first in range(0, count + 1, _AT_ONCE):
        share = np.arange(first, min(first + _AT_ONCE, count + 1)) / count
        found = states(body, start + (end - start) * share[:, None])
        touching = found[(found != FREE) & (found != SIGHT)]
        if len(touching):
            return int(touching[0])
    return FREE
