"""Looking up the joint map in the search, compiled: the free options of a viewing direction in 0.1 µs.

With one roll every branch is an option. With more, every roll of the first branch that has one: one branch for a whole
tour costs little, and the search stays cheap (robot notes, section 2). All options of a lookup lie side by side in
memory and are interpolated together, also those that are not free: that is quicker than picking them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools
from netdesign.model.compiled import FAST, entry

LANES = 4  # options are counted in whole vectors: kernels run over the rest of the last one and ignore it
_HALF_TURN = np.float32(math.pi)
_NONE = np.float32(0.0)
_FINITE = FAST | {"nnan", "ninf"}


class MapArrays(NamedTuple):
    """The map as the kernels take it; G nodes along a side, R rolls, B branches, r joints.

    joints (R, G, G, B, r) float32 rad; state (R, G, G, B) int8.

    For the search, K options side by side in each of S sets, tried in turn: the B branches in one set, or the R rolls
    in a set for every branch, the one with the most free nodes first. blocks (G, G, S, width): joints of option k at
    k r, k r + 1, …; turns (width,): 2 pi where a joint wraps, else 0; usable (G - 1, G - 1, S): bit k is set where
    option k is free and smooth at all four corners of the cell.

    half: disc coordinate of the last node; most: columns for the options of a lookup, a multiple of LANES.
    """

    joints: NDArray[np.float32]
    state: NDArray[np.int8]
    blocks: NDArray[np.float32]
    turns: NDArray[np.float32]
    usable: NDArray[np.uint32]
    half: float
    most: int


def map_arrays(
    joints: NDArray[np.float32],
    state: NDArray[np.int8],
    good: Bools,
    wraps: Bools,
    half: float,
    labels: NDArray[np.int64],
) -> MapArrays:
    """Return the arrays for the kernels.

    Args:
        good: (R, G - 1, G - 1, B) cells in which a branch can be interpolated.  wraps: (r,).
        labels: (B,) branches, the one with the most free nodes first.
    """
    rolls, size, r = joints.shape[0], joints.shape[1], joints.shape[-1]
    # (G, G, S, K, r): one roll has its branches side by side, several rolls are side by side for each branch.
    sets = joints.transpose(1, 2, 0, 3, 4) if rolls == 1 else joints[:, :, :, labels].transpose(1, 2, 3, 0, 4)
    bits = good.transpose(1, 2, 0, 3) if rolls == 1 else good[..., labels].transpose(1, 2, 3, 0)
    count, options = sets.shape[2:4]
    width = -(-options * r // 8) * 8
    blocks = np.zeros((size, size, count, width), dtype=np.float32)
    blocks[..., : options * r] = sets.reshape(size, size, count, options * r)
    turns = np.zeros(width, dtype=np.float32)
    turns[: options * r] = np.tile(np.where(wraps, 2.0 * np.pi, 0.0), options)
    usable = (bits * np.left_shift(1, np.arange(options), dtype=np.int64)).sum(axis=-1).astype(np.uint32)
    return MapArrays(joints, state, blocks, turns, usable, half, -(-options // LANES) * LANES)


@entry(fastmath=_FINITE)
def options_of(arrays, directions, block, options, count):  # type: ignore[no-untyped-def]
    """Write the free options of unit directions (n, 3) into options (n, r, most), their numbers into count (n,).

    Directions without any are taken out, in place: returns how many are left. block: scratch (width,) float32.
    All directions in one call: entering a function with arrays takes numba longer than an interpolation.
    """
    blocks, turns, usable = arrays.blocks, arrays.turns, arrays.usable
    size, sets, width = blocks.shape[0], blocks.shape[2], blocks.shape[3]
    r = options.shape[1]
    middle = 0.5 * (size - 1)
    kept = 0
    for of in range(directions.shape[0]):
        # Nothing is mapped near the nadir, where the projection has no direction.
        to_node = math.sqrt(2.0 / max(1.0 + directions[of, 2], 1e-9)) / arrays.half * middle
        x = min(max(directions[of, 0] * to_node + middle, -1.0), size)
        y = min(max(directions[of, 1] * to_node + middle, -1.0), size)
        i, j = int(x), int(y)
        if x < 0.0 or y < 0.0 or i > size - 2 or j > size - 2:
            continue
        s = 0
        while s < sets - 1 and not usable[i, j, s]:
            s += 1
        bits = usable[i, j, s]
        if not bits:
            continue
        u, v = x - i, y - j
        w1, w2, w3 = np.float32(u * (1.0 - v)), np.float32((1.0 - u) * v), np.float32(u * v)
        for w in range(width):
            q, turn = blocks[i, j, s, w], turns[w]
            d1, d2, d3 = blocks[i + 1, j, s, w] - q, blocks[i, j + 1, s, w] - q, blocks[i + 1, j + 1, s, w] - q
            # Neighbours differ by less than half a turn, so one whole turn is all there can be to take out.
            d1 += turn if d1 < -_HALF_TURN else (-turn if d1 > _HALF_TURN else _NONE)
            d2 += turn if d2 < -_HALF_TURN else (-turn if d2 > _HALF_TURN else _NONE)
            d3 += turn if d3 < -_HALF_TURN else (-turn if d3 > _HALF_TURN else _NONE)
            block[w] = q + w1 * d1 + w2 * d2 + w3 * d3
        found, start = 0, 0
        while bits:
            if bits & 1:
                for a in range(r):
                    options[kept, a, found] = block[start + a]
                found += 1
            bits >>= 1
            start += r
        count[kept] = found
        for axis in range(3):
            directions[kept, axis] = directions[of, axis]
        kept += 1
    return kept
