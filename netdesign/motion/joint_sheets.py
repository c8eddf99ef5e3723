"""Joint sheets for arms without a closed form: smooth sets of solutions over the grid, found by flooding.

A sheet starts from one solution at one node and spreads to the neighbours (in both disc coordinates and in roll) by
Levenberg–Marquardt from the node it comes from; it ends at limits, singularities and jumps. A seventh joint is held at
a few values, each with its own sheets: a redundant arm has a continuum of solutions, and a sheet must be one of them.
"""

import math

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import entry
from netdesign.motion.kinematics import refine, restarts, solve_restarts
from netdesign.motion.robot import Chain

# The joint that is held on an arm of seven: the third, the upper arm's roll of every common design.
REDUNDANT = 2
_HELD_VALUES = 5
_MOST_SHEETS = 10
_ANCHORS = 12
_STARTS = 12
_SMALLEST_SHEET = 0.02
_LARGEST_JUMP = 0.6
_SAME = 0.05


def free_joints(chain: Chain) -> Bools:
    """Return which joints (r,) an inverse solution may move."""
    free = np.ones(len(chain), dtype=np.bool_)
    if len(chain) == 7:
        free[REDUNDANT] = False
    return free


def held_values(chain: Chain) -> Floats:
    """Return the values of the held joint, a single 0 when the arm has none."""
    if len(chain) != 7:
        return np.zeros(1)
    low, high = max(float(chain.lower[REDUNDANT]), -np.pi / 2), min(float(chain.upper[REDUNDANT]), np.pi / 2)
    return np.linspace(low, high, _HELD_VALUES)


def sheets(chain: Chain, targets: Floats) -> tuple[Floats, Bools]:
    """Return joints (R, G, G, B, r) and which exist (R, G, G, B) at targets (R, G, G, 4, 4), the largest sheet first.

    A target of zeros is no target. At most ``_MOST_SHEETS`` sheets are kept.
    """
    layers, size = targets.shape[:2]
    wanted = targets[..., 3, 3] == 1.0
    nodes = np.argwhere(wanted)
    anchors = nodes[np.linspace(0, len(nodes) - 1, _ANCHORS).astype(np.int64)]
    free = free_joints(chain)
    kept: list[tuple[Floats, Bools]] = []
    for index, held in enumerate(held_values(chain)):
        for number, anchor in enumerate(anchors):
            for start in restarts(chain, _STARTS, seed=100 * index + number):
                q = start.copy()
                if not free.all():
                    q[REDUNDANT] = held
                if not solve_restarts(
                    chain.placements, chain.last_from_flange, chain.lower, chain.upper, chain.wraps, free,
                    targets[tuple(anchor)], q, np.empty((0, len(chain))),
                ):  # fmt: skip
                    continue
                if any(found[tuple(anchor)] and _near(chain, joints[tuple(anchor)], q) for joints, found in kept):
                    continue
                joints = np.zeros((layers, size, size, len(chain)))
                found = np.zeros((layers, size, size), dtype=np.bool_)
                _flood(
                    chain.placements, chain.last_from_flange, chain.lower, chain.upper, chain.wraps, free,
                    targets, wanted, anchor, q, joints, found,
                )  # fmt: skip
                if found.sum() >= _SMALLEST_SHEET * len(nodes):
                    kept.append((joints, found))
    kept.sort(key=lambda sheet: -int(sheet[1].sum()))
    kept = kept[:_MOST_SHEETS]
    if not kept:
        return np.zeros((layers, size, size, 1, len(chain))), np.zeros((layers, size, size, 1), dtype=np.bool_)
    return np.stack([joints for joints, _ in kept], axis=3), np.stack([found for _, found in kept], axis=3)


def _near(chain: Chain, first: Floats, second: Floats) -> bool:
    difference = first - second
    difference = np.where(chain.wraps, difference - 2 * np.pi * np.rint(difference / (2 * np.pi)), difference)
    return bool(np.abs(difference).max() < _SAME)


@entry()
def _flood(placements, last_from_flange, lower, upper, wraps, free, targets, wanted, anchor, start, joints, found):  # type: ignore[no-untyped-def]
    """Spread the solution ``start`` (r,) from node ``anchor`` (3,) over joints (R, G, G, r) and found (R, G, G)."""
    layers, size, r = joints.shape[0], joints.shape[1], joints.shape[3]
    queue = np.empty((layers * size * size, 3), dtype=np.int64)
    queue[0] = anchor
    found[anchor[0], anchor[1], anchor[2]] = True
    joints[anchor[0], anchor[1], anchor[2]] = start
    head, tail = 0, 1
    q = np.empty(r)
    turn = 2.0 * math.pi
    while head < tail:
        k, i, j = queue[head]
        head += 1
        for side in range(6 if layers > 1 else 4):
            nk, ni, nj = k, i, j
            if side == 0:
                ni += 1
            elif side == 1:
                ni -= 1
            elif side == 2:
                nj += 1
            elif side == 3:
                nj -= 1
            elif side == 4:
                nk = (k + 1) % layers
            else:
                nk = (k + layers - 1) % layers
            if ni < 0 or nj < 0 or ni >= size or nj >= size or found[nk, ni, nj] or not wanted[nk, ni, nj]:
                continue
            here = joints[k, i, j]
            for a in range(r):
                q[a] = here[a]
            if not refine(placements, last_from_flange, lower, upper, wraps, free, targets[nk, ni, nj], q):
                continue
            jump = 0.0
            for a in range(r):
                d = q[a] - here[a]
                if wraps[a]:
                    d -= turn * math.floor(d / turn + 0.5)
                jump = max(jump, abs(d))
            # A step in roll turns the last joints by as much as the roll itself.
            if jump > (_LARGEST_JUMP if side < 4 else _LARGEST_JUMP + turn / layers):
                continue
            found[nk, ni, nj] = True
            joints[nk, ni, nj] = q
            queue[tail, 0], queue[tail, 1], queue[tail, 2] = nk, ni, nj
            tail += 1
