"""Closed-form inverse kinematics of arms built like Universal Robots': all eight branches.

Needs, of the joint axes at joint values zero: 2, 3 and 4 parallel (direction h), 1 perpendicular to h, 5 perpendicular
to h, 5 and 6 meeting in a point w. That is read from the chain, not from a model name. With e_i the rotation about axis
i (product of exponentials) and G = base_from_flange(q) base_from_flange(0)^-1 = e1 e2 e3 e4 e5 e6:

* w stays under e5 e6, and e2 e3 e4 keep every point's height along h: h·(e1^-1 G w) = h·w gives q1 (two: shoulder);
* h·(R5 a6) = h·(R1^T R_G a6), a6 the direction of axis 6, gives q5 (two: wrist);
* R6^T (R5^T h) = R_G^T R1 h gives q6;
* what is left is a planar arm e2 e3 e4 = e1^-1 G (e5 e6)^-1: q3 by the law of cosines (two: elbow), then q2 and q4.

Branch label = 4 shoulder + 2 wrist + elbow, stable over the workspace.
"""

import math
from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats, frozen
from netdesign.model.compiled import part
from netdesign.model.frames import inverse
from netdesign.motion.kinematics import base_from_flange
from netdesign.motion.robot import Chain

BRANCHES = 8


@dataclass(frozen=True, kw_only=True)
class UrArm:
    """The geometry of the closed form, base frame, joint values zero.

    Attributes:
        axes: (6, 3) unit directions.  points: (4, 3) m on axes 1 to 4.  wrist: (3,) m, where axes 5 and 6 meet.
        flange_inverse: (4, 4), base_from_flange(0)^-1.
    """

    axes: Floats
    points: Floats
    wrist: Floats
    flange_inverse: Floats

    def __post_init__(self) -> None:
        for name, shape in (("axes", (6, 3)), ("points", (4, 3)), ("wrist", (3,)), ("flange_inverse", (4, 4))):
            object.__setattr__(self, name, frozen(name, getattr(self, name), shape))


def ur_arm(chain: Chain, tolerance: float = 1e-9) -> UrArm | None:
    """Return the closed form's geometry, or None for an arm that is built otherwise."""
    if len(chain) != 6:
        return None
    base_from_link = np.eye(4)
    axes, points = [], []
    for placement in chain.placements:
        base_from_link = base_from_link @ placement
        axes.append(base_from_link[:3, 2])
        points.append(base_from_link[:3, 3])
    a = np.array(axes)
    parallel = max(np.linalg.norm(np.cross(a[1], a[2])), np.linalg.norm(np.cross(a[1], a[3])))
    square = max(abs(a[0] @ a[1]), abs(a[4] @ a[3]))
    across = np.cross(a[4], a[5])
    if parallel > tolerance or square > tolerance or np.linalg.norm(across) < 0.1:
        return None
    offset = points[5] - points[4]
    if abs(offset @ across) > tolerance:
        return None
    # The point of axis 5 that lies on axis 6: solve s a5 - t a6 = offset in the least-squares sense.
    (along, _), *_ = np.linalg.lstsq(np.stack([a[4], -a[5]], axis=1), offset, rcond=None)
    flange = base_from_flange(chain, np.zeros((1, 6)))[0]
    return UrArm(axes=a, points=np.array(points[:4]), wrist=points[4] + along * a[4], flange_inverse=inverse(flange))


# Vectors are tuples of three here: numba compiles them in a fraction of the time it takes for array expressions.


@part()
def _row(array, index):  # type: ignore[no-untyped-def]
    return array[index, 0], array[index, 1], array[index, 2]


@part()
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part()
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part()
def _sum(a, scale, b):  # type: ignore[no-untyped-def]
    """Return a + scale b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@part()
def _turn(axis, angle, v):  # type: ignore[no-untyped-def]
    """Return v turned about a unit axis (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    along = (1.0 - c) * _dot(axis, v)
    w = _cross(axis, v)
    return (
        c * v[0] + s * w[0] + along * axis[0],
        c * v[1] + s * w[1] + along * axis[1],
        c * v[2] + s * w[2] + along * axis[2],
    )


@part()
def _angle_about(axis, start, end):  # type: ignore[no-untyped-def]
    """Return the angle about a unit axis that takes the part of ``start`` normal to it to that of ``end``."""
    return math.atan2(_dot(axis, _cross(start, end)), _dot(start, end) - _dot(axis, start) * _dot(axis, end))


@part()
def _rotated(g, v):  # type: ignore[no-untyped-def]
    return (
        g[0, 0] * v[0] + g[0, 1] * v[1] + g[0, 2] * v[2],
        g[1, 0] * v[0] + g[1, 1] * v[1] + g[1, 2] * v[2],
        g[2, 0] * v[0] + g[2, 1] * v[1] + g[2, 2] * v[2],
    )


@part()
def _rotated_back(g, v):  # type: ignore[no-untyped-def]
    return (
        g[0, 0] * v[0] + g[1, 0] * v[1] + g[2, 0] * v[2],
        g[0, 1] * v[0] + g[1, 1] * v[1] + g[2, 1] * v[2],
        g[0, 2] * v[0] + g[1, 2] * v[1] + g[2, 2] * v[2],
    )


@part()
def _two_angles(a, b, c):  # type: ignore[no-untyped-def]
    """Return (middle, half) of the two solutions middle ± half of a cos x + b sin x = c; half < 0 when none.

    A value past the edge by rounding counts as the edge.
    """
    length = math.hypot(a, b)
    if length < 1e-12 or abs(c) > length * (1.0 + 1e-9):
        return 0.0, -1.0
    return math.atan2(b, a), math.acos(min(max(c / length, -1.0), 1.0))


@part()
def ur_branches(axes, points, wrist, flange_inverse, target, q, found):  # type: ignore[no-untyped-def]
    """Write the joints of every branch into q (8, 6), each in (-pi, pi], and whether it exists into found (8,).

    target: base_from_flange (4, 4). Limits are not looked at.
    """
    g = np.empty((3, 4))
    for a in range(3):
        for b in range(4):
            g[a, b] = target[a, 3] if b == 3 else 0.0
            for k in range(3):
                g[a, b] += target[a, k] * flange_inverse[k, b]
    a1, h, a5, a6 = _row(axes, 0), _row(axes, 1), _row(axes, 4), _row(axes, 5)
    p1, p2, p3, p4 = _row(points, 0), _row(points, 1), _row(points, 2), _row(points, 3)
    w = (wrist[0], wrist[1], wrist[2])
    # Signs that make joints 3 and 4 turn about h itself.
    sign3 = 1.0 if _dot(_row(axes, 2), h) > 0.0 else -1.0
    sign4 = 1.0 if _dot(_row(axes, 3), h) > 0.0 else -1.0
    for label in range(BRANCHES):
        found[label] = False
    moved = _sum(_sum(_rotated(g, w), 1.0, (g[0, 3], g[1, 3], g[2, 3])), -1.0, p1)
    # h·(R(-q1) moved) = moved·(R(q1) h); R(q1) h = h cos + (a1 x h) sin since h is normal to a1.
    side = _cross(a1, h)
    middle1, half1 = _two_angles(_dot(moved, h), _dot(moved, side), _dot(_sum(w, -1.0, p1), h))
    if half1 < 0.0:
        return
    link2, link3 = _sum(p3, -1.0, p2), _sum(p4, -1.0, p3)
    link2, link3 = _sum(link2, -_dot(link2, h), h), _sum(link3, -_dot(link3, h), h)
    rest = _angle_about(h, link2, link3)
    long2, long3 = _dot(link2, link2), _dot(link3, link3)
    sixth = _rotated(g, a6)
    for shoulder in range(2):
        q1 = middle1 + (half1 if shoulder == 0 else -half1)
        # h·(R5 a6) = cos q5 h·a6 + sin q5 h·(a5 x a6), h normal to a5.
        middle5, half5 = _two_angles(_dot(h, a6), _dot(h, _cross(a5, a6)), _dot(h, _turn(a1, -q1, sixth)))
        if half5 < 0.0:
            continue
        seen = _rotated_back(g, _turn(a1, q1, h))
        wrist_now = _sum(_turn(a1, -q1, moved), 1.0, p1)
        for wrist_branch in range(2):
            q5 = middle5 + (half5 if wrist_branch == 0 else -half5)
            q6 = -_angle_about(a6, _turn(a5, -q5, h), seen)
            # The planar arm's rotation of v is R1^T R_G R6^T R5^T v; e2 e3 e4 takes w to wrist_now.
            turned = _turn(a1, -q1, _rotated(g, _turn(a6, -q6, _turn(a5, -q5, side))))
            arm = _turn(a1, -q1, _rotated(g, _turn(a6, -q6, _turn(a5, -q5, _sum(p4, -1.0, w)))))
            reach = _sum(_sum(arm, 1.0, wrist_now), -1.0, p2)
            reach = _sum(reach, -_dot(reach, h), h)
            total = _angle_about(h, side, turned)
            cosine = (_dot(reach, reach) - long2 - long3) / (2.0 * math.sqrt(long2 * long3))
            if abs(cosine) > 1.0 + 1e-9:
                continue
            bend = math.acos(min(max(cosine, -1.0), 1.0))
            for elbow in range(2):
                q3 = (bend if elbow == 0 else -bend) - rest
                q2 = _angle_about(h, _sum(link2, 1.0, _turn(h, q3, link3)), reach)
                label = 4 * shoulder + 2 * wrist_branch + elbow
                q[label, 0], q[label, 1], q[label, 2] = q1, q2, sign3 * q3
                q[label, 3], q[label, 4], q[label, 5] = sign4 * (total - q2 - q3), q5, q6
                for i in range(6):
                    q[label, i] = math.pi - (math.pi - q[label, i]) % (2.0 * math.pi)
                found[label] = True
