"""Exact joint options of the stations of a plan: every branch at every roll, solved to the pose, tested, and lifted."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.motion.cell import ArmCell
from netdesign.motion.collision import FREE, LIMITS, NO_SOLUTION, REASONS, alone, states
from netdesign.motion.inverse import rest_of, solve_closed, tested
from netdesign.motion.joint_lookup import LANES
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_sheets import free_joints
from netdesign.motion.kinematics import into_limits, refine, restarts
from netdesign.motion.ur_kinematics import BRANCHES

PLAN_ROLLS = 24
NO_POSES = np.zeros((0, 4, 4))
_POSE_STARTS = 100  # of the numerical solution at a pose anywhere
_SAME = 1e-6  # rad
_TURN = 2.0 * np.pi


@dataclass(frozen=True, kw_only=True)
class StationOptions:
    """Joint options of n stations, option by column as the kernels want them.

    Attributes:
        joints: (n, r, K) rad, each inside the limits; K a multiple of LANES.
        count: (n,).  label: (n, K) branch of each option.
        refused: station index and reason of the stations without any option.
    """

    joints: Floats
    count: Ints
    label: Ints
    refused: tuple[tuple[int, str], ...]

    def keep(self, station: int, chosen: list[int]) -> tuple[Floats, Ints]:
        """Return joints (k, r) and labels (k,) of some options of a station."""
        return self.joints[station][:, chosen].T, self.label[station, chosen]


def exact_options(joint_map: JointMap, viewpoints: Floats, given: Floats = NO_POSES) -> StationOptions:
    """Return the exact options of poses ``given`` (e, 4, 4), then of viewpoints (n, 2 or 3) of the map's sphere.

    Closed form, or refined from the sheets of the map. A given pose keeps its roll. A station that capsules leave
    without an option is tested again with the real meshes.
    """
    solve = _closed_options if joint_map.arm.ur is not None else _sheet_options
    found = [_options_of_pose(joint_map, pose) for pose in given]
    found += [solve(joint_map, viewpoint) for viewpoint in viewpoints]
    arm = joint_map.arm
    kept: list[tuple[Floats, Ints]] = []
    refused: list[tuple[int, str]] = []
    for index, (joints, label, reason) in enumerate(found):
        state = states(arm.body, joints) if len(joints) else np.zeros(0, dtype=np.int8)
        free = state == FREE
        if arm.loose:
            state[free] = [arm.meshes.state(q) for q in joints[free]]
            free = state == FREE
        if len(joints) and not free.any():
            free = _free_on_meshes(arm, joints)
            reason = REASONS[int(np.bincount(state).argmax())]
        if not free.any():
            refused.append((index, reason))
        kept.append((joints[free], label[free]))
    return _packed(kept, len(arm.chain), tuple(refused))


def _free_on_meshes(arm: ArmCell, joints: Floats) -> Bools:
    """Return which of joints (k, r) are free on the real meshes, the line of sight still by capsules."""
    sees = states(alone(arm.body)._replace(pairs=arm.body.pairs[:0], sight=arm.body.sight), joints) == FREE
    return np.array([clear and not arm.meshes.contact(q) for clear, q in zip(sees.tolist(), joints, strict=True)])


def lifted(options: StationOptions, chosen: list[list[int]], lower: Floats, upper: Floats) -> StationOptions:
    """Return the chosen options of every station in every turn of every joint inside the limits (r,).

    Their labels count branch and turns of the first three joints together: what a collision on a leg depends on.
    """
    kept = []
    numbers: dict[tuple[int, ...], int] = {}
    for station, indices in enumerate(chosen):
        copies: list[tuple[float, ...]] = []
        labels: list[int] = []
        for q, branch in zip(*options.keep(station, indices), strict=True):
            values = q.tolist()
            turns = [
                [turn for turn in (0, -1, 1) if low <= value + turn * _TURN <= high]
                for value, low, high in zip(values, lower.tolist(), upper.tolist(), strict=True)
            ]
            for combination in itertools.product(*turns):
                copies.append(tuple(value + turn * _TURN for value, turn in zip(values, combination, strict=True)))
                labels.append(numbers.setdefault((int(branch), *combination[:3]), len(numbers)))
        kept.append((np.array(copies), np.array(labels, dtype=np.int64)))
    return _packed(kept, options.joints.shape[1], ())


def _packed(kept: list[tuple[Floats, Ints]], r: int, refused: tuple[tuple[int, str], ...]) -> StationOptions:
    most = -(-max([len(joints) for joints, _ in kept] + [1]) // LANES) * LANES
    packed, labels = np.zeros((len(kept), r, most)), np.zeros((len(kept), most), dtype=np.int64)
    for index, (joints, label) in enumerate(kept):
        packed[index, :, : len(joints)] = joints.T.reshape(r, len(joints))
        labels[index, : len(joints)] = label
    count = np.array([len(joints) for joints, _ in kept], dtype=np.int64)
    return StationOptions(joints=packed, count=count, label=labels, refused=refused)


def _rolls(joint_map: JointMap) -> Floats:
    if joint_map.sphere.roll is not None or joint_map.follows:
        return joint_map.rolls
    count = PLAN_ROLLS if joint_map.arm.ur is not None else len(joint_map.rolls)
    return np.arange(count, dtype=np.float64) * (_TURN / count)


def search_options(joint_map: JointMap, viewpoints: Floats) -> list[Floats]:
    """Return the joints (k, r) that capsules call free of each of viewpoints (n, 2 or 3), at the rolls of a search.

    What a map tells by interpolation, for stations without a map: solved exactly, none left out.
    """
    arm, sphere, rolls = joint_map.arm, joint_map.sphere, joint_map.rolls
    if arm.ur is None:
        solved = [_sheet_options(joint_map, viewpoint)[0] for viewpoint in viewpoints]
        return [joints[arm.states(joints) == FREE] if len(joints) else joints for joints in solved]
    targets = sphere.cameras(np.repeat(viewpoints, len(rolls), axis=0), np.tile(rolls, len(viewpoints)))
    joints, found = solve_closed(arm, targets)
    free = tested(arm, joints, found, rest_of(arm) if joint_map.follows else math.nan) == FREE
    shape = (len(viewpoints), len(rolls) * BRANCHES, joints.shape[-1])
    return [q[kept] for q, kept in zip(joints.reshape(shape), free.reshape(shape[:2]), strict=True)]


def _options_of_pose(joint_map: JointMap, pose: Floats) -> tuple[Floats, Ints, str]:
    """Return joints (k, r) inside the limits at a pose (4, 4) anywhere, their labels (k,), and why there are none."""
    arm, placed = joint_map.arm, joint_map.arm.placed
    if arm.ur is not None:
        return _inside(arm, *solve_closed(arm, pose[None]))
    found: list[Floats] = []
    for start in restarts(placed, _POSE_STARTS):
        q = start.copy()
        if refine(
            placed.placements, placed.last_from_flange, placed.lower, placed.upper, placed.wraps,
            np.ones(len(placed), np.bool_), pose, q,
        ) and not any(np.abs(q - other).max() < _SAME for other in found):  # fmt: skip
            found.append(q)
    joints = np.array(found).reshape(-1, len(placed))
    return joints, np.arange(len(joints)), REASONS[NO_SOLUTION]


def _inside(arm: ArmCell, solved: Floats, found: Bools) -> tuple[Floats, Ints, str]:
    """Return the joints (k, 6) inside the limits among solved (n, 8, 6), their branches (k,), why none."""
    label = np.broadcast_to(np.arange(found.shape[1]), found.shape)[found]
    joints = np.ascontiguousarray(solved[found])
    if not len(joints):
        return joints.reshape(0, len(arm.placed)), label, REASONS[NO_SOLUTION]
    inside = np.array([into_limits(q, arm.placed.lower, arm.placed.upper) for q in joints])
    return joints[inside], label[inside], REASONS[LIMITS]


def _closed_options(joint_map: JointMap, viewpoint: Floats) -> tuple[Floats, Ints, str]:
    """Return joints (k, 6) inside the limits, their branch labels (k,), and why there are none."""
    rolls = _rolls(joint_map)
    targets = joint_map.sphere.cameras(np.tile(viewpoint, (len(rolls), 1)), rolls)
    solved, found = solve_closed(joint_map.arm, targets)
    if joint_map.follows:
        solved[..., -1] = rest_of(joint_map.arm)
    return _inside(joint_map.arm, solved, found)


def _sheet_options(joint_map: JointMap, viewpoint: Floats) -> tuple[Floats, Ints, str]:
    """Return joints (k, r), the sheet of each (k,), and why there are none."""
    sphere, placed = joint_map.sphere, joint_map.arm.placed
    free = free_joints(placed)
    joints, label = [], []
    for layer, roll in enumerate(_rolls(joint_map)):
        target = sphere.cameras(viewpoint, roll)
        for sheet, start in joint_map.near(viewpoint, layer):
            q = start.copy()
            if refine(
                placed.placements, placed.last_from_flange, placed.lower, placed.upper, placed.wraps, free, target, q
            ):
                joints.append(q)
                label.append(sheet)
    return np.array(joints).reshape(-1, len(placed)), np.array(label, dtype=np.int64), REASONS[NO_SOLUTION]
