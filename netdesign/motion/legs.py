"""Between two stations: is the straight joint line free, and if not, over which via points is it?"""

import itertools
from collections.abc import Callable

import numpy as np
from scipy.sparse.csgraph import dijkstra

from netdesign.model.arrays import Floats, Ints
from netdesign.motion.collision import FREE, SIGHT, leg_state, states
from netdesign.motion.joint_map import JointMap
from netdesign.motion.kinematics import restarts
from netdesign.motion.robot import Chain

# 0.02 rad moves the tip of an outstretched UR10 by 26 mm: between two tests it stays within the margin of 20 mm.
_STEP = 0.02
_TURN = 2.0 * np.pi
_NEAR, _ANYWHERE = 150, 400  # nodes of a roadmap over the map's joints, and over joints drawn anywhere
_DRAWN = 20_000
_NEIGHBOURS = 12
_LAZY_ROUNDS = 2  # per node
_STOP = 0.1  # rad: what a via point costs on top of its way


class Legs:
    """Tests legs of one cell and remembers the answers."""

    def __init__(self, joint_map: JointMap) -> None:
        self._map = joint_map
        self._arm = joint_map.arm
        self._known: dict[bytes, str] = {}
        self._ways: dict[bytes, Floats | None] = {}
        self._free: Floats | None = None

    def contact(self, start: Floats, end: Floats) -> str:
        """Return what is touched on the straight line from start to end (r,), "" when it is free.

        Capsules first; what they refuse is tested on the real meshes.
        """
        key = start.tobytes() + end.tobytes()
        if key not in self._known:
            found = ""
            if self._arm.loose or leg_state(self._arm.body, start, end, _STEP) != FREE:
                found = self._arm.meshes.leg_contact(start, end, _STEP)
            self._known[key] = found
        return self._known[key]

    def detour(self, start: Floats, end: Floats) -> Floats | None:
        """Return via points (k, r) of a free way from start to end (r,), None when none is found.

        Over joints that look at the part, which are near, or over any: backing off from it may be the only way. The way
        back is the same.
        """
        key, back = start.tobytes() + end.tobytes(), end.tobytes() + start.tobytes()
        if key not in self._ways:
            found = self._way(start, end, self._mapped, _NEAR)
            found = self._way(start, end, self._drawn, _ANYWHERE) if found is None else found
            self._ways |= {key: found, back: None if found is None else found[::-1]}
        return self._ways[key]

    def _way(self, start: Floats, end: Floats, joints: Callable[[], Floats], most: int) -> Floats | None:
        """Return the via points of the shortest free way over at most so many of some joints (c, r), None without one.

        A lazy roadmap: nodes are free joints, each in the turns nearest to the leg, joined to their nearest; the
        shortest way is tested leg by leg, legs that collide are taken out, and so on.
        Legs must be free for the capsules, which contain the meshes. Source: R. Bohlin, L. E. Kavraki, ICRA 2000.
        """
        middles = [share * start + (1.0 - share) * end for share in (0.0, 0.5, 1.0)]
        nodes = np.unique(np.concatenate([self._turned(joints(), middle) for middle in middles]), axis=0)
        way = np.linalg.norm(nodes - start, axis=1) + np.linalg.norm(nodes - end, axis=1)
        nodes = np.concatenate([[start, end], nodes[np.argsort(way, kind="stable")[:most]]])
        distance = np.linalg.norm(nodes[:, None] - nodes, axis=2)
        near = np.argsort(distance, axis=1, kind="stable")[:, 1 : _NEIGHBOURS + 1]
        weights = np.zeros_like(distance)
        rows = np.repeat(np.arange(len(nodes)), near.shape[1])
        weights[rows, near.ravel()] = distance[rows, near.ravel()] + _STOP
        weights[:2] = distance[:2] + _STOP
        weights = np.maximum(weights, weights.T)
        weights[0, 1] = weights[1, 0] = 0.0
        np.fill_diagonal(weights, 0.0)
        tested: set[tuple[int, int]] = set()
        for _ in range(max(200, _LAZY_ROUNDS * len(nodes))):
            _, before = dijkstra(weights, indices=0, return_predecessors=True)
            path = [1]
            while path[-1] != 0 and before[path[-1]] >= 0:
                path.append(int(before[path[-1]]))
            if path[-1] != 0:
                return None
            colliding = False
            for a, b in itertools.pairwise(path[::-1]):
                if (a, b) not in tested and not self._clear(nodes[a], nodes[b]):
                    weights[a, b] = weights[b, a] = 0.0
                    colliding = True
                    break
                tested |= {(a, b), (b, a)}
            if not colliding:
                return np.array(nodes[path[-2:0:-1]])
        return None

    def _clear(self, start: Floats, end: Floats) -> bool:
        if leg_state(self._arm.body, start, end, _STEP) != FREE:
            return False
        return not (self._arm.loose and self._arm.meshes.leg_contact(start, end, _STEP))

    def _turned(self, joints: Floats, middle: Floats) -> Floats:
        """Return joints (c, r) in the turns nearest to others (r,), as far as the limits allow."""
        placed = self._arm.placed
        turned = joints + np.where(placed.wraps, _TURN * np.rint((middle - joints) / _TURN), 0.0)
        inside = (turned >= placed.lower) & (turned <= placed.upper)
        return np.ascontiguousarray(np.where(inside, turned, joints))

    def _mapped(self) -> Floats:
        """Return free joints (c, r) of a coarse subset of the map."""
        found = []
        for arrays in self._map.shells:
            step, rolls = max(arrays.state.shape[1] // 12, 1), max(len(arrays.state) // 4, 1)
            free = arrays.state[::rolls, ::step, ::step] == FREE
            found.append(arrays.joints[::rolls, ::step, ::step][free])
        return np.concatenate(found).astype(np.float64)

    def _drawn(self) -> Floats:
        """Return free joints (c, r) drawn evenly over the limits; whether the view is blocked does not matter."""
        if self._free is None:
            joints = restarts(self._arm.placed, _DRAWN, seed=3)
            self._free = joints[np.isin(states(self._arm.body, joints), (FREE, SIGHT))]
        return self._free


def turned_towards(home: Floats, joints: Floats, chain: Chain) -> Floats:
    """Return a tour (n, r) with every joint turned as a whole, inside its limits, so that its ends are near home (r,).

    Whole turns of a joint along the whole tour change neither a pose nor a leg.
    """
    best, ends = joints.copy(), joints[[0, -1]]
    for a in np.flatnonzero(chain.wraps):
        lowest, highest = joints[:, a].min(), joints[:, a].max()
        fit = [
            turn for turn in (0.0, _TURN, -_TURN) if chain.lower[a] <= lowest + turn <= highest + turn <= chain.upper[a]
        ]
        gaps = [float(np.abs(ends[:, a] + turn - home[a]).sum()) for turn in fit]
        best[:, a] += fit[int(np.argmin(gaps))] if fit else 0.0
    return best


def home_legs(
    legs: Legs, home: Floats, joints: Floats, order: Ints
) -> tuple[tuple[str, ...], tuple[tuple[int, str], ...]]:
    """Return what is to be said about the ways from home to the first station and back, and who cannot be reached."""
    notes: list[str] = []
    for station, name in ((0, "the way from home"), (len(joints) - 1, "the way home")):
        contact = legs.contact(home, joints[station])
        found = legs.detour(home, joints[station]) if contact else None
        if contact and found is None:
            return (), ((int(order[station]), f"no free way between home and this station: {contact}"),)
        if found is not None:
            notes.append(f"{name} goes over {len(found)} via point(s): on the straight line {contact}")
    return tuple(notes), ()
