"""Between two stations: is the straight joint line free, and if not, over which via points is it?"""

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.motion.collision import FREE, leg_state
from netdesign.motion.joint_map import JointMap

# 0.02 rad moves the tip of an outstretched UR10 by 26 mm: between two tests it stays within the margin of 20 mm.
_STEP = 0.02
_TURN = 2.0 * np.pi
_NEAREST_VIAS = 150
_ROADMAP = 40


class Legs:
    """Tests legs of one cell and remembers the answers."""

    def __init__(self, joint_map: JointMap) -> None:
        self._map = joint_map
        self._arm = joint_map.arm
        self._known: dict[bytes, str] = {}

    def contact(self, start: Floats, end: Floats) -> str:
        """Return what is touched on the straight line from start to end (r,), "" when it is free.

        Capsules first; what they refuse is tested on the real meshes.
        """
        key = start.tobytes() + end.tobytes()
        if key not in self._known:
            found = ""
            if leg_state(self._arm.body, start, end, _STEP) != FREE:
                found = self._arm.meshes.leg_contact(start, end, _STEP)
            self._known[key] = found
        return self._known[key]

    def detour(self, start: Floats, end: Floats) -> Floats | None:
        """Return via points (k, r), k <= 2, of a free way from start to end, None when there is none among those tried.

        Candidates are the free joints of a coarse subset of the map's nodes, each in the turn nearest to the leg.
        """
        candidates = self._candidates(0.5 * (start + end))
        way = np.linalg.norm(candidates - start, axis=1) + np.linalg.norm(candidates - end, axis=1)
        order = np.argsort(way, kind="stable")
        for index in order[:_NEAREST_VIAS]:
            via = candidates[index]
            if not self.contact(start, via) and not self.contact(via, end):
                return np.array(via[None])
        near = candidates[order[:_ROADMAP]]
        leaving = [via for via in near if not self.contact(start, via)]
        arriving = [via for via in near if not self.contact(via, end)]
        pairs = [(first, second) for first in leaving for second in arriving]
        pairs.sort(key=lambda pair: _length(np.stack([start, pair[0], pair[1], end])))
        for first, second in pairs[:_NEAREST_VIAS]:
            if not self.contact(first, second):
                return np.stack([first, second])
        return None

    def _candidates(self, middle: Floats) -> Floats:
        arrays, placed = self._map.arrays, self._arm.placed
        step = max(arrays.state.shape[1] // 12, 1)
        state = arrays.state[:: max(len(arrays.state) // 4, 1), ::step, ::step]
        joints = arrays.joints[:: max(len(arrays.state) // 4, 1), ::step, ::step][state == FREE].astype(np.float64)
        turned = joints + np.where(placed.wraps, _TURN * np.rint((middle - joints) / _TURN), 0.0)
        inside = (turned >= placed.lower) & (turned <= placed.upper)
        return np.ascontiguousarray(np.where(inside, turned, joints))


def _length(way: Floats) -> float:
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
