"""Joints of camera poses: the closed form of many poses at once, limits and collisions tested."""

import math

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import entry
from netdesign.motion.cell import ArmCell
from netdesign.motion.collision import FREE, LIMITS, NO_SOLUTION
from netdesign.motion.kinematics import into_limits
from netdesign.motion.ur_kinematics import BRANCHES, ur_branches


def rest_of(arm: ArmCell) -> float:
    """Return the value of a last joint that never moves: 0, or the nearest its limits allow."""
    return float(np.clip(0.0, arm.placed.lower[-1], arm.placed.upper[-1]))


def tested(arm: ArmCell, joints: Floats, found: Bools, rest: float) -> NDArray[np.int8]:
    """Bring joints (…, r) rad that exist (…) into their limits, in place; return their states (…), see ``collision``.

    ``rest``: value of the last joint everywhere, NaN to leave it. Capsules decide: what they call free is free.
    """
    flat = joints.reshape(-1, joints.shape[-1])
    state: NDArray[np.int8] = _limited(arm.placed.lower, arm.placed.upper, flat, found.reshape(-1), rest)
    within = state == FREE
    state[within] = arm.states(flat[within])
    return state.reshape(found.shape)


def solve_closed(arm: ArmCell, targets: Floats) -> tuple[Floats, Bools]:
    """Return joints (N, 8, 6) and which exist (N, 8) of targets world_from_cam (N, 4, 4) by the closed form.

    Raises:
        ValueError: the arm has no closed form.
    """
    if arm.ur is None:
        raise ValueError(f"{arm.chain.name}: expected an arm with a closed form")
    solved, found = np.zeros((len(targets), BRANCHES, 6)), np.zeros((len(targets), BRANCHES), dtype=np.bool_)
    geometry = arm.ur
    _closed(geometry.axes, geometry.points, geometry.wrist, geometry.flange_inverse, targets, solved, found)
    return solved, found


@entry()
def _closed(
    axes: Floats, points: Floats, wrist: Floats, flange_inverse: Floats, targets: Floats, solved: Floats, found: Bools
) -> None:
    for node in range(targets.shape[0]):
        if targets[node, 3, 3] == 1.0:
            ur_branches(axes, points, wrist, flange_inverse, targets[node], solved[node], found[node])


@entry()
def _limited(lower: Floats, upper: Floats, joints: Floats, found: Bools, rest: float) -> NDArray[np.int8]:
    """Bring joints (N, r) into their limits in place; return NO_SOLUTION, LIMITS or FREE (N,) int8.

    ``rest``: value of the last joint everywhere, NaN to leave it.
    """
    count, r = joints.shape
    state = np.empty(count, dtype=np.int8)
    for i in range(count):
        state[i] = NO_SOLUTION
        if not found[i]:
            continue
        if not math.isnan(rest):
            joints[i, r - 1] = rest
        state[i] = FREE if into_limits(joints[i], lower, upper) else LIMITS
    return state
