"""Looking up the joint map in the search, compiled: the free options of a viewing direction in a microsecond."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Ints


class MapArrays(NamedTuple):
    """The map as the kernels take it.

    joints (R, G, G, B, r) float32 rad; state (R, G, G, B) int8; usable (R, G - 1, G - 1) uint16: bit b is set where
    branch b is free and smooth at all four corners of the cell; half: disc coordinate of the last node; labels (B,):
    branches, the one with the most free nodes first; most: options a lookup can return.
    """

    joints: NDArray[np.float32]
    state: NDArray[np.int8]
    usable: NDArray[np.uint16]
    half: float
    labels: Ints
    wraps: Bools
    most: int


@njit(cache=True, error_model="numpy")
def options_at(arrays, alpha, beta, out):  # type: ignore[no-untyped-def]
    """Write the free options of a viewing direction into out (r, K), option by column; return how many there are.

    With one roll every branch is an option. With more, every roll of the first label that has one: one branch for a
    whole tour costs little, and the search stays cheap (robot notes, section 2).
    """
    rolls, size, branches, r = (
        arrays.state.shape[0], arrays.state.shape[1], arrays.state.shape[3], arrays.joints.shape[4],
    )  # fmt: skip
    radius = 2.0 * math.sin(0.25 * math.pi - 0.5 * beta)
    x = (radius * math.cos(alpha) / arrays.half + 1.0) * 0.5 * (size - 1)
    y = (radius * math.sin(alpha) / arrays.half + 1.0) * 0.5 * (size - 1)
    i, j = int(x), int(y)
    if x < 0.0 or y < 0.0 or i > size - 2 or j > size - 2:
        return 0
    u, v = x - i, y - j
    w1, w2, w3 = u * (1.0 - v), (1.0 - u) * v, u * v
    turn = 2.0 * math.pi
    count = 0
    for position in range(branches):
        b = arrays.labels[position]
        for k in range(rolls):
            if not arrays.usable[k, i, j] >> b & 1:
                continue
            for a in range(r):
                q0 = float(arrays.joints[k, i, j, b, a])
                d1 = float(arrays.joints[k, i + 1, j, b, a]) - q0
                d2 = float(arrays.joints[k, i, j + 1, b, a]) - q0
                d3 = float(arrays.joints[k, i + 1, j + 1, b, a]) - q0
                if arrays.wraps[a]:
                    # Neighbours differ by less than half a turn, so one whole turn is all there can be to take out.
                    d1 += turn if d1 < -math.pi else (-turn if d1 > math.pi else 0.0)
                    d2 += turn if d2 < -math.pi else (-turn if d2 > math.pi else 0.0)
                    d3 += turn if d3 < -math.pi else (-turn if d3 > math.pi else 0.0)
                out[a, count] = q0 + w1 * d1 + w2 * d2 + w3 * d3
            count += 1
            if count == out.shape[1]:
                return count
        if rolls > 1 and count:
            return count
    return count
