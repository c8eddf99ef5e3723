"""Joints for every viewing direction, computed once: the inverse kinematics the search can afford.

The viewing sphere is gridded in Lambert's equal-area azimuthal projection about the top view: no pole, cells of one
area. At every node, roll and branch the map keeps the joints and a state (``collision.REASONS``). A lookup
interpolates bilinearly between the four nodes around a direction, joint by joint and with whole turns taken out, and
only where all four are free (conservative). The interpolation is for the search; a plan solves the pose exactly.

Branches are the closed form's labels, or sheets found by flooding the grid (``joint_sheets``).

Disc coordinates of a unit direction u: (ux, uy) sqrt(2 / (1 + uz)); the disc of elevation beta has radius
2 sin((pi/2 - beta) / 2). Source: J. P. Snyder, Map Projections, USGS Prof. Paper 1395, 1987, chapter 24.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.scene import Part
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import RobotCell
from netdesign.motion.cell import ArmCell, load_arm
from netdesign.motion.collision import FREE, LIMITS, NO_SOLUTION, REASONS, states
from netdesign.motion.joint_lookup import MapArrays, map_arrays, options_of
from netdesign.motion.joint_sheets import sheets
from netdesign.motion.kinematics import into_limits
from netdesign.motion.stored import Arrays, content_key, stored
from netdesign.motion.ur_kinematics import BRANCHES, ur_branches

_VERSION = 3
SEARCH_ROLLS = 12
_GRID_CLOSED = {1: 128, SEARCH_ROLLS: 64}
_GRID_SHEETS = {1: 64, SEARCH_ROLLS: 36}
# Neighbouring nodes whose joints differ by more belong to different sheets, or to a singularity.
_LARGEST_JUMP = 0.8


@dataclass(frozen=True, kw_only=True)
class JointMap:
    """Joint options over a viewing sphere.

    Attributes:
        arrays: for the kernels.
        rolls: (R,) rad, roll of each layer; one layer that leaves the last joint at rest when ``follows`` is set.
        follows: the camera looks along the last joint's axis and its roll is free: the last joint never moves.
    """

    arm: ArmCell
    sphere: ViewingSphere
    arrays: MapArrays
    rolls: Floats
    follows: bool

    @classmethod
    def build(
        cls, cell: RobotCell, sphere: ViewingSphere, part: Part, rolls: int | None = None, grid: int | None = None
    ) -> "JointMap":
        """Build the map, or take it from the disk cache when nothing it depends on has changed.

        Args:
            rolls: number of rolls when the sphere leaves the roll free.  grid: nodes along a side of the disc.

        Raises:
            InputError: see ``motion.robot.load_chain``.
        """
        return cls.of_arm(load_arm(cell, sphere, part), sphere, rolls, grid)

    @classmethod
    def of_arm(
        cls, arm: ArmCell, sphere: ViewingSphere, rolls: int | None = None, grid: int | None = None
    ) -> "JointMap":
        """Build the map of a loaded arm, see ``build``."""
        follows = sphere.roll is None and arm.coaxial and arm.ur is not None
        count = (rolls or SEARCH_ROLLS) if sphere.roll is None and not follows else 1
        angles: Floats = np.arange(count, dtype=np.float64) * (2.0 * np.pi / count) + (sphere.roll or 0.0)
        sizes = _GRID_CLOSED if arm.ur is not None else _GRID_SHEETS
        size = grid or sizes.get(count, sizes[SEARCH_ROLLS])
        low = max(sphere.elevation[0], -0.5 * np.pi + 0.02)
        radius = 2.0 * np.sin(0.25 * np.pi - 0.5 * low)
        half = float(radius * (1.0 + 3.0 / (size - 1)))
        targets = _targets(sphere, angles, size, half)
        key = content_key("joint map", _VERSION, arm.key, targets, follows)
        kept = stored(key, lambda: _fill(arm, targets, follows))
        free = (kept["state"] == FREE).sum(axis=(0, 1, 2))
        labels = np.argsort(-free, kind="stable").astype(np.int64)
        arrays = map_arrays(kept["joints"], kept["state"], kept["good"], np.array(arm.placed.wraps), half, labels)
        return cls(arm=arm, sphere=sphere, arrays=arrays, rolls=angles, follows=follows)

    def options(self, viewpoints: Floats) -> tuple[Floats, Ints]:
        """Return interpolated joints (n, r, K) rad and how many of the K are valid (n,), viewpoints (n, 2)."""
        directions = sphere_directions(viewpoints)
        joints = np.zeros((len(directions), self.arrays.joints.shape[-1], self.arrays.most))
        count, block = np.zeros(len(directions), dtype=np.int64), np.empty_like(self.arrays.turns)
        for i in range(len(directions)):
            here = slice(i, i + 1)
            options_of(self.arrays, directions[here], block, joints[here], count[here])
        return joints, count

    @property
    def rest(self) -> float:
        """The value in rad of a last joint that never moves (``follows``)."""
        return _rest(self.arm)

    def near(self, viewpoint: Floats, layer: int) -> list[tuple[int, Floats]]:
        """Return (branch, joints (r,)) of what exists at the nodes around a viewpoint (2,) in one roll layer."""
        size = self.arrays.state.shape[1]
        x, y = (np.array(_disc(viewpoint[None]))[:, 0] / self.arrays.half + 1.0) * 0.5 * (size - 1)
        found = []
        corners = [(i, j) for i in (int(x), int(x) + 1) for j in (int(y), int(y) + 1) if max(i, j) < size]
        corners.sort(key=lambda node: (node[0] - x) ** 2 + (node[1] - y) ** 2)
        for branch in range(self.arrays.state.shape[3]):
            for i, j in corners:
                if self.arrays.state[layer, i, j, branch] != NO_SOLUTION:
                    found.append((branch, self.arrays.joints[layer, i, j, branch].astype(np.float64)))
                    break
        return found

    def reachable(self, viewpoints: Floats) -> Bools:
        """Return whether each of viewpoints (n, 2) has a free option."""
        return self.options(viewpoints)[1] > 0

    def reasons(self, viewpoints: Floats) -> list[str]:
        """Return, for viewpoints (n, 2), the reason of the best option at the nearest node, "free" where reachable."""
        directions = np.stack(_disc(viewpoints), axis=-1)
        size = self.arrays.state.shape[1]
        node = np.clip(np.rint((directions / self.arrays.half + 1.0) * 0.5 * (size - 1)), 0, size - 1).astype(int)
        best = [_best_state(self.arrays.state[:, i, j]) for i, j in node]
        free = self.reachable(viewpoints)
        # Free at the nearest node but not at all four around: the edge of a region; the neighbours say of which.
        edge = [
            _best_state(self.arrays.state[:, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2], worst=True) for i, j in node
        ]
        return [
            REASONS[FREE] if ok else REASONS[state if state != FREE else around]
            for ok, state, around in zip(free.tolist(), best, edge, strict=True)
        ]

    def share(self, elevation: tuple[float, float] | None = None, samples: int = 8000) -> dict[str, float]:
        """Return the share of the sphere's admissible area for each reason, from a golden-angle lattice.

        Free is what all four nodes around a direction call free: a lower bound, 1 % below the exact share.
        """
        found = self.reasons(self.lattice(elevation, samples))
        return {reason: found.count(reason) / samples for reason in REASONS}

    def lattice(self, elevation: tuple[float, float] | None = None, samples: int = 8000) -> Floats:
        """Return viewpoints (samples, 2) rad spread over the admissible sphere, each standing for the same area."""
        low, high = elevation or self.sphere.elevation
        alpha_low, alpha_high = self.sphere.azimuth
        index = np.arange(samples) + 0.5
        beta = np.arcsin(np.sin(low) + (np.sin(high) - np.sin(low)) * index / samples)
        golden = 0.5 * (np.sqrt(5.0) - 1.0)
        alpha = alpha_low + (alpha_high - alpha_low) * ((index * golden) % 1.0)
        return np.stack([alpha, beta], axis=1)


def _rest(arm: ArmCell) -> float:
    """Return the value of a last joint that never moves: 0, or the nearest its limits allow."""
    return float(np.clip(0.0, arm.placed.lower[-1], arm.placed.upper[-1]))


def _best_state(states: NDArray[np.int8], worst: bool = False) -> int:
    """Return FREE if any option is free, else the state that came furthest along the tests, as a count decides."""
    counts = np.bincount(states.ravel(), minlength=len(REASONS))
    if not worst and counts[FREE]:
        return FREE
    refused = counts[NO_SOLUTION + 1 :]
    return int(refused.argmax()) + NO_SOLUTION + 1 if refused.any() else NO_SOLUTION


def _disc(viewpoints: Floats) -> tuple[Any, Any]:
    alpha, beta = viewpoints[:, 0], viewpoints[:, 1]
    radius = 2.0 * np.sin(0.25 * np.pi - 0.5 * beta)
    return radius * np.cos(alpha), radius * np.sin(alpha)


def _targets(sphere: ViewingSphere, rolls: Floats, size: int, half: float) -> Floats:
    """Return world_from_cam (R, G, G, 4, 4) of every node; all zero where the disc has no direction."""
    steps = np.linspace(-half, half, size)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    square = x * x + y * y
    inside = (square < 4.0 - 1e-6) & (square <= half * half)
    scale = np.sqrt(np.maximum(1.0 - 0.25 * square, 0.0))
    outward = np.stack([x * scale, y * scale, 1.0 - 0.5 * square], axis=-1)
    outward[~inside] = (0.0, 0.0, 1.0)
    poses = np.stack([look_at(sphere.centre + sphere.radius * outward, sphere.centre, roll) for roll in rolls])
    poses[:, ~inside] = 0.0
    return poses


def _fill(arm: ArmCell, targets: Floats, follows: bool) -> Arrays:
    """Return joints (R, G, G, B, r) and states (R, G, G, B) at targets (R, G, G, 4, 4)."""
    shape = targets.shape[:3]
    if arm.ur is None:
        solved, found = sheets(arm.placed, targets)
    else:
        solved, found = solve_closed(arm, targets.reshape(-1, 4, 4))
        solved, found = solved.reshape(*shape, BRANCHES, 6), found.reshape(*shape, BRANCHES)
    count, r = found.shape[-1], solved.shape[-1]
    rest = _rest(arm) if follows else math.nan
    flat = solved.reshape(-1, r)
    state = _limited(arm.placed.lower, arm.placed.upper, flat, found.reshape(-1), rest)
    within = state == FREE
    state[within] = states(arm.body, flat[within])
    joints, state = flat.reshape(solved.shape).astype(np.float32), state.reshape(*shape, count)
    return {"joints": joints, "state": state, "good": _good(joints, state, np.array(arm.placed.wraps))}


def _good(joints: NDArray[np.float32], state: NDArray[np.int8], wraps: Bools) -> Bools:
    """Return the cells (R, G - 1, G - 1, B) in which a branch can be interpolated."""
    corners = [(slice(i, i - 1 or None), slice(j, j - 1 or None)) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))]
    good: Bools = np.logical_and.reduce([state[:, i, j] == FREE for i, j in corners])
    for i, j in corners[1:]:
        change = joints[:, i, j] - joints[:, :-1, :-1]
        change -= np.where(wraps, 2.0 * np.pi * np.rint(change / (2.0 * np.pi)), 0.0)
        good &= np.abs(change).max(axis=-1) <= _LARGEST_JUMP
    return good


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
def _closed(axes, points, wrist, flange_inverse, targets, solved, found):  # type: ignore[no-untyped-def]
    for node in range(targets.shape[0]):
        if targets[node, 3, 3] == 1.0:
            ur_branches(axes, points, wrist, flange_inverse, targets[node], solved[node], found[node])


@entry()
def _limited(lower, upper, joints, found, rest):  # type: ignore[no-untyped-def]
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
