"""Joints for every viewing direction, computed once: the inverse kinematics the search can afford.

The viewing sphere is gridded in Lambert's equal-area azimuthal projection about the top view: no pole, cells of one
area. At every node, roll and branch the map keeps the joints and a state (``collision.REASONS``). A lookup
interpolates bilinearly between the four nodes around a direction, joint by joint and with whole turns taken out, and
only where all four are free (conservative). The interpolation is for the search; a plan solves the pose exactly.

Stations with a depth have such a grid on a few shells through it. They are too coarse to search on (``options`` solves
each station), but they say why stations are refused, and where joint sheets and via points are.

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
from netdesign.model.frames import look_at, sphere_directions, viewpoints_of
from netdesign.model.scene import Part
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import RobotCell
from netdesign.motion.cell import ArmCell, load_arm
from netdesign.motion.collision import FREE, NO_SOLUTION, REASONS
from netdesign.motion.inverse import rest_of, solve_closed, tested
from netdesign.motion.joint_lookup import MapArrays, map_arrays, options_of
from netdesign.motion.joint_sheets import sheets
from netdesign.motion.stored import Arrays, content_key, stored
from netdesign.motion.ur_kinematics import BRANCHES

_VERSION = 4
SEARCH_ROLLS = 12
_GRID_CLOSED = {1: 128, SEARCH_ROLLS: 64}
_GRID_SHEETS = {1: 64, SEARCH_ROLLS: 36}
# Neighbouring nodes whose joints differ by more belong to different sheets, or to a singularity.
_LARGEST_JUMP = 0.8
_SHELLS = (0.0, 0.5, 1.0)  # shares of the depth, where there is one


@dataclass(frozen=True, kw_only=True)
class JointMap:
    """Joint options over a viewing sphere.

    Attributes:
        shells: arrays for the kernels, of the sphere or of every share (s,) of the depth in ``shares``.
        rolls: (R,) rad, roll of each layer; one layer that leaves the last joint at rest when ``follows`` is set.
        follows: the camera looks along the last joint's axis and its roll is free: the last joint never moves.
    """

    arm: ArmCell
    sphere: ViewingSphere
    shells: tuple[MapArrays, ...]
    shares: Floats
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
        size = grid or sizes[count if count in sizes and sphere.depth is None else SEARCH_ROLLS]
        low = max(sphere.elevation[0], -0.5 * np.pi + 0.02)
        radius = 2.0 * np.sin(0.25 * np.pi - 0.5 * low)
        half = float(radius * (1.0 + 3.0 / (size - 1)))
        shares = np.array(_SHELLS if sphere.depth is not None and sphere.depth.has_width else (0.5,))
        shells = tuple(_shell(arm, _targets(sphere, angles, size, half, share), half, follows) for share in shares)
        return cls(arm=arm, sphere=sphere, shells=shells, shares=shares, rolls=angles, follows=follows)

    @property
    def arrays(self) -> MapArrays:
        """The only shell, of stations on one sphere."""
        return self.shells[0]

    def options(self, viewpoints: Floats) -> tuple[Floats, Ints]:
        """Return interpolated joints (n, r, K) rad and how many are valid (n,) at viewpoints (n, 2) of a sphere."""
        directions = sphere_directions(viewpoints)
        joints = np.zeros((len(directions), self.arrays.joints.shape[-1], self.arrays.most))
        count, block = np.zeros(len(directions), dtype=np.int64), np.empty_like(self.arrays.turns)
        for i in range(len(directions)):
            here = slice(i, i + 1)
            options_of(self.arrays, directions[here], block, joints[here], count[here])
        return joints, count

    def near(self, viewpoint: Floats, layer: int) -> list[tuple[int, Floats]]:
        """Return (branch, joints (r,)) of what exists at the nodes around a viewpoint (2 or 3,) in one roll layer."""
        arrays = self.shells[int(self._nearest(viewpoint[None])[0])]
        size = arrays.state.shape[1]
        x, y = (np.array(_disc(viewpoint[None]))[:, 0] / arrays.half + 1.0) * 0.5 * (size - 1)
        found = []
        corners = [(i, j) for i in (int(x), int(x) + 1) for j in (int(y), int(y) + 1) if max(i, j) < size]
        corners.sort(key=lambda node: (node[0] - x) ** 2 + (node[1] - y) ** 2)
        for branch in range(arrays.state.shape[3]):
            for i, j in corners:
                if arrays.state[layer, i, j, branch] != NO_SOLUTION:
                    found.append((branch, arrays.joints[layer, i, j, branch].astype(np.float64)))
                    break
        return found

    def reachable(self, viewpoints: Floats) -> Bools:
        """Return whether each of viewpoints (n, 2) on a sphere has a free option."""
        return self.options(viewpoints)[1] > 0

    def reasons(self, viewpoints: Floats) -> list[str]:
        """Return the reason of the best option at the node nearest to each of viewpoints (n, 2 or 3).

        "free" only where all four nodes around are.
        """
        directions, size = np.stack(_disc(viewpoints), axis=-1), self.arrays.state.shape[1]
        at = (directions / self.arrays.half + 1.0) * 0.5 * (size - 1)
        node, cell = np.clip(np.rint(at), 0, size - 1).astype(int), np.clip(at, 0, size - 2).astype(int)
        reasons = []
        mapped = ((at >= 0.0) & (at < size - 1)).all(axis=1).tolist()
        for shell, (i, j), (a, b), within in zip(self._nearest(viewpoints), node, cell, mapped, strict=True):
            arrays = self.shells[shell]
            if within and arrays.usable[a, b].any():
                reasons.append(REASONS[FREE])
                continue
            best = _best_state(arrays.state[:, i, j])
            # Free at the nearest node but not at all four around: the edge of a region; the neighbours say of which.
            around = arrays.state[:, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
            reasons.append(REASONS[best if best != FREE else _best_state(around, worst=True)])
        return reasons

    def _nearest(self, viewpoints: Floats) -> Ints:
        """Return the shell (n,) nearest to each of viewpoints (n, 2 or 3)."""
        if len(self.shells) == 1:
            return np.zeros(len(viewpoints), np.int64)
        return np.asarray(np.abs(viewpoints[:, 2:] - self.shares).argmin(axis=1))

    def share(self, samples: int = 8000) -> dict[str, float]:
        """Return the share of the admissible sphere (of every shell) for each reason, from a golden-angle lattice.

        Free is what all four nodes around a direction call free: a lower bound, 1 % below the exact share.
        """
        found = self.reasons(self.lattice(samples))
        return {reason: found.count(reason) / len(found) for reason in REASONS}

    def lattice(self, samples: int) -> Floats:
        """Return viewpoints (c, 2) rad spread over the admissible sphere, each standing for the same area.

        With a depth: (c, 3), the directions one after the other on every shell.
        """
        low, high = self.sphere.elevation
        alpha_low, alpha_high = self.sphere.azimuth
        index = np.arange(samples) + 0.5
        beta = np.arcsin(np.sin(low) + (np.sin(high) - np.sin(low)) * index / samples)
        golden = 0.5 * (np.sqrt(5.0) - 1.0)
        alpha = alpha_low + (alpha_high - alpha_low) * ((index * golden) % 1.0)
        if self.sphere.depth is None:
            return np.stack([alpha, beta], axis=1)
        viewpoints = np.stack([alpha, beta, self.shares[np.arange(samples) % len(self.shares)]], axis=1)
        return viewpoints[self.sphere.admissible(viewpoints)]


def _shell(arm: ArmCell, targets: Floats, half: float, follows: bool) -> MapArrays:
    """Return the arrays of one shell, from the disk when they are there."""
    key = content_key("joint map", _VERSION, arm.key, targets, follows)
    kept = stored(key, lambda: _fill(arm, targets, follows))
    free = (kept["state"] == FREE).sum(axis=(0, 1, 2))
    labels = np.argsort(-free, kind="stable").astype(np.int64)
    return map_arrays(kept["joints"], kept["state"], kept["good"], np.array(arm.placed.wraps), half, labels)


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


def _targets(sphere: ViewingSphere, rolls: Floats, size: int, half: float, share: float) -> Floats:
    """Return world_from_cam (R, G, G, 4, 4) of every node; all zero where the disc has no direction or no station."""
    steps = np.linspace(-half, half, size)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    square = x * x + y * y
    inside = (square < 4.0 - 1e-6) & (square <= half * half)
    scale = np.sqrt(np.maximum(1.0 - 0.25 * square, 0.0))
    outward = np.stack([x * scale, y * scale, 1.0 - 0.5 * square], axis=-1)
    outward[~inside] = (0.0, 0.0, 1.0)
    radii = sphere.radii(np.concatenate([viewpoints_of(outward), np.full((size, size, 1), share)], axis=-1))
    inside &= np.isfinite(radii)
    places = sphere.centre + np.where(inside, radii, sphere.radius)[..., None] * outward
    poses = np.stack([look_at(places, sphere.centre, roll) for roll in rolls])
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
    state = tested(arm, solved, found, rest_of(arm) if follows else math.nan)
    joints = solved.astype(np.float32)
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
