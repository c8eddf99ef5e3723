"""Forward kinematics, Jacobian and numerical inverse kinematics of a serial arm, compiled.

Kernels take the arm as three arrays of the ``Chain``: placements (r, 4, 4), last_from_flange (4, 4) and, where joints
are searched for, the limits. Angles rad, lengths m, base frame = the URDF's root.

Numerical inverse kinematics is Levenberg–Marquardt on the six pose errors; the rotation error is the rotation vector
of R_flange^T R_target times ``_ARM`` m, so that both halves have one unit. A joint that wraps is searched without
limits and turned back afterwards: clamping it loses two solutions in three (measured, robot notes section 2).
"""

import math

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import entry, part
from netdesign.motion.robot import Chain

_ARM = 0.3
_TURN = 2.0 * math.pi
_ITERATIONS = 60
_TOLERANCE = 1e-13
_SLACK = 1e-9  # rad: a limit met up to rounding counts as met


@entry()
def link_poses(placements, q, out):  # type: ignore[no-untyped-def]
    """Write base_from_link (r, 3, 4) of every moving link into ``out``."""
    r = q.shape[0]
    rot = np.eye(3)
    pos = np.zeros(3)
    for i in range(r):
        p = placements[i]
        c, s = math.cos(q[i]), math.sin(q[i])
        new = out[i]
        for a in range(3):
            x = rot[a, 0] * p[0, 0] + rot[a, 1] * p[1, 0] + rot[a, 2] * p[2, 0]
            y = rot[a, 0] * p[0, 1] + rot[a, 1] * p[1, 1] + rot[a, 2] * p[2, 1]
            z = rot[a, 0] * p[0, 2] + rot[a, 1] * p[1, 2] + rot[a, 2] * p[2, 2]
            new[a, 3] = pos[a] + rot[a, 0] * p[0, 3] + rot[a, 1] * p[1, 3] + rot[a, 2] * p[2, 3]
            new[a, 0] = x * c + y * s
            new[a, 1] = y * c - x * s
            new[a, 2] = z
        for a in range(3):
            for b in range(3):
                rot[a, b] = new[a, b]
            pos[a] = new[a, 3]


@part()
def flange_of(last_link, last_from_flange, out):  # type: ignore[no-untyped-def]
    """Write base_from_flange (3, 4) of the last link's pose (3, 4) into ``out``."""
    for a in range(3):
        for b in range(4):
            value = last_link[a, 3] if b == 3 else 0.0
            for k in range(3):
                value += last_link[a, k] * last_from_flange[k, b]
            out[a, b] = value


@entry()
def forward(placements, last_from_flange, joints):  # type: ignore[no-untyped-def]
    """Return base_from_flange (n, 4, 4) of joints (n, r)."""
    n, r = joints.shape
    links = np.empty((r, 3, 4))
    out = np.zeros((n, 4, 4))
    for i in range(n):
        link_poses(placements, joints[i], links)
        flange_of(links[r - 1], last_from_flange, out[i])
        out[i, 3, 3] = 1.0
    return out


@part()
def _pose_error(flange, target, error):  # type: ignore[no-untyped-def]
    """Write position error (m) and ``_ARM`` times the rotation vector, both in the base frame; return the norm."""
    e = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            e[a, b] = target[a, 0] * flange[b, 0] + target[a, 1] * flange[b, 1] + target[a, 2] * flange[b, 2]
    vx, vy, vz = 0.5 * (e[2, 1] - e[1, 2]), 0.5 * (e[0, 2] - e[2, 0]), 0.5 * (e[1, 0] - e[0, 1])
    sine = math.sqrt(vx * vx + vy * vy + vz * vz)
    cosine = 0.5 * (e[0, 0] + e[1, 1] + e[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if sine > 1e-9:
        scale = angle / sine
    elif cosine > 0.0:
        scale = 1.0
    else:
        # Half a turn: any start out of this saddle will do.
        scale, vx = 1.0, math.pi
    error[0] = target[0, 3] - flange[0, 3]
    error[1] = target[1, 3] - flange[1, 3]
    error[2] = target[2, 3] - flange[2, 3]
    error[3], error[4], error[5] = _ARM * scale * vx, _ARM * scale * vy, _ARM * scale * vz
    total = 0.0
    for a in range(6):
        total += error[a] * error[a]
    return total


@part()
def _fill_jacobian(links, flange, free, jacobian):  # type: ignore[no-untyped-def]
    """Write the base-frame Jacobian (6, r), rotation rows times ``_ARM``; columns of joints held are zero."""
    for i in range(links.shape[0]):
        zx, zy, zz = links[i, 0, 2], links[i, 1, 2], links[i, 2, 2]
        dx, dy, dz = flange[0, 3] - links[i, 0, 3], flange[1, 3] - links[i, 1, 3], flange[2, 3] - links[i, 2, 3]
        on = 1.0 if free[i] else 0.0
        jacobian[0, i] = on * (zy * dz - zz * dy)
        jacobian[1, i] = on * (zz * dx - zx * dz)
        jacobian[2, i] = on * (zx * dy - zy * dx)
        jacobian[3, i], jacobian[4, i], jacobian[5, i] = on * _ARM * zx, on * _ARM * zy, on * _ARM * zz


@part()
def _solve_damped(jacobian, error, damping, step):  # type: ignore[no-untyped-def]
    """Write J^T (J J^T + damping I)^-1 e into ``step`` by Cholesky of the 6 x 6 matrix."""
    r = jacobian.shape[1]
    a = np.empty((6, 6))
    y = np.empty(6)
    for i in range(6):
        for j in range(i + 1):
            value = damping if i == j else 0.0
            for k in range(r):
                value += jacobian[i, k] * jacobian[j, k]
            for k in range(j):
                value -= a[i, k] * a[j, k]
            if i == j:
                a[i, i] = math.sqrt(max(value, 1e-300))
            else:
                a[i, j] = value / a[j, j]
        value = error[i]
        for k in range(i):
            value -= a[i, k] * y[k]
        y[i] = value / a[i, i]
    for i in range(5, -1, -1):
        value = y[i]
        for k in range(i + 1, 6):
            value -= a[k, i] * y[k]
        y[i] = value / a[i, i]
    for k in range(r):
        value = 0.0
        for i in range(6):
            value += jacobian[i, k] * y[i]
        step[k] = value


@part()
def into_limits(q, lower, upper):  # type: ignore[no-untyped-def]
    """Turn every joint of q (r,) by whole turns to the value inside its limits nearest zero, in place.

    Returns whether all limits can hold; one that cannot is left nearest zero.
    """
    inside = True
    for i in range(q.shape[0]):
        best, value = math.inf, q[i] - _TURN * math.floor(q[i] / _TURN + 0.5)
        nearest = value
        for turn in range(-2, 3):
            shifted = value + turn * _TURN
            if lower[i] - _SLACK <= shifted <= upper[i] + _SLACK and abs(shifted) < best:
                best, nearest = abs(shifted), shifted
        q[i] = min(max(nearest, lower[i]), upper[i]) if best < math.inf else nearest
        inside = inside and best < math.inf
    return inside


@entry()
def refine(placements, last_from_flange, lower, upper, wraps, free, target, q):  # type: ignore[no-untyped-def]
    """Move q (r,) in place to the pose target (4, 4) = base_from_flange; return whether it got there within limits.

    Only joints with ``free`` move. Wrapping joints are not clamped but turned back at the end.
    """
    r = q.shape[0]
    links, flange, jacobian = np.empty((r, 3, 4)), np.empty((3, 4)), np.empty((6, r))
    error, trial_error, step, trial = np.empty(6), np.empty(6), np.empty(r), np.empty(r)
    link_poses(placements, q, links)
    flange_of(links[r - 1], last_from_flange, flange)
    cost = _pose_error(flange, target, error)
    damping, stalled = 1e-3 * cost, 0
    for _ in range(_ITERATIONS):
        if cost < _TOLERANCE * _TOLERANCE or stalled > 4:
            break
        _fill_jacobian(links, flange, free, jacobian)
        _solve_damped(jacobian, error, damping, step)
        for i in range(r):
            trial[i] = q[i] + step[i]
            if not wraps[i]:
                trial[i] = min(max(trial[i], lower[i]), upper[i])
        link_poses(placements, trial, links)
        flange_of(links[r - 1], last_from_flange, flange)
        trial_cost = _pose_error(flange, target, trial_error)
        if trial_cost < cost:
            stalled = stalled + 1 if trial_cost > 0.98 * cost else 0
            cost, damping = trial_cost, min(0.2 * damping, 1e-2 * trial_cost)
            for i in range(r):
                q[i] = trial[i]
            for a in range(6):
                error[a] = trial_error[a]
        else:
            stalled += 1
            damping = max(10.0 * damping, 1e-12)
            link_poses(placements, q, links)
            flange_of(links[r - 1], last_from_flange, flange)
    return cost < 1e-20 and into_limits(q, lower, upper)


@entry()
def solve_restarts(placements, last_from_flange, lower, upper, wraps, free, target, q, starts):  # type: ignore[no-untyped-def]
    """Like ``refine`` from q, then from each of starts (s, r) until one succeeds; joints held keep q's value."""
    held = q.copy()
    if refine(placements, last_from_flange, lower, upper, wraps, free, target, q):
        return True
    for s in range(starts.shape[0]):
        for i in range(q.shape[0]):
            q[i] = starts[s, i] if free[i] else held[i]
        if refine(placements, last_from_flange, lower, upper, wraps, free, target, q):
            return True
    return False


def base_from_flange(chain: Chain, joints: Floats) -> Floats:
    """Return the flange poses (n, 4, 4) m of joints (n, r) rad."""
    joints = np.ascontiguousarray(joints, dtype=np.float64)  # writable, as a Body's: compiled once for both
    return np.asarray(forward(np.array(chain.placements), np.array(chain.last_from_flange), joints))


def restarts(chain: Chain, count: int, seed: int = 0) -> Floats:
    """Return start values (count, r) spread over the joint ranges, wrapping joints over one turn."""
    low = np.where(chain.wraps, -np.pi, chain.lower)
    high = np.where(chain.wraps, np.pi, chain.upper)
    return low + (high - low) * np.random.default_rng(seed).random((count, len(chain)))


def solve(chain: Chain, target: Floats, starts: Floats, free: Bools | None = None) -> tuple[Floats, bool]:
    """Return (joints (r,), found) for one flange pose (4, 4), from each of starts (s, r) until one succeeds.

    Exact to 1e-10 m and rad where found. ``free`` (r,): joints that may move; the others keep starts[0].
    """
    q = np.array(starts[0], dtype=np.float64)
    moving = np.ones(len(chain), dtype=np.bool_) if free is None else np.asarray(free)
    found = solve_restarts(
        chain.placements, chain.last_from_flange, chain.lower, chain.upper, chain.wraps, moving,
        np.ascontiguousarray(target), q, np.ascontiguousarray(starts[1:]),
    )  # fmt: skip
    return q, bool(found)
