"""The optimum of small joint tours: Held and Karp's subsets, with the option of the last station in the state.

Time n² K² 2ⁿ: meant for n K up to about 80. Source: M. Held, R. M. Karp, J. SIAM 10(1), 1962, extended by options.
"""

import numpy as np

from netdesign.model.compiled import entry
from netdesign.motion.joint_tour import legs_along


@entry()
def exact_joint_tour(options, count, label, barred, law, timed):  # type: ignore[no-untyped-def]
    """Return (closed tour (n + 1,) with the dummy in front, choice (n,), length), arguments as in ``joint_tour``."""
    n, _, most = options.shape
    legs, pair, block = np.empty((n, most, n, most)), np.zeros(3, dtype=np.int64), np.empty((2, most, most))
    for i in range(n):
        for j in range(n):
            pair[1], pair[2] = i + 1, j + 1
            legs_along(options, count, pair, law, timed, block)
            for k in range(count[i]):
                for c in range(count[j]):
                    legs[i, k, j, c] = block[1, k, c]
                    if barred.size:
                        legs[i, k, j, c] += barred[i, j, label[i, k], label[j, c]]
    full = (1 << n) - 1
    shortest = np.full((1 << n, n, most), np.inf)
    before = np.zeros((1 << n, n, most), dtype=np.int64)
    for i in range(n):
        for k in range(count[i]):
            shortest[1 << i, i, k] = 0.0
    for subset in range(1, full):
        for i in range(n):
            if not subset >> i & 1:
                continue
            for k in range(count[i]):
                here = shortest[subset, i, k]
                for j in range(n):
                    if subset >> j & 1:
                        continue
                    longer = subset | 1 << j
                    for c in range(count[j]):
                        value = here + legs[i, k, j, c]
                        if value < shortest[longer, j, c]:
                            shortest[longer, j, c] = value
                            before[longer, j, c] = i * most + k
    i, k = 0, 0
    for j in range(n):
        for c in range(count[j]):
            if shortest[full, j, c] < shortest[full, i, k]:
                i, k = j, c
    length = shortest[full, i, k]
    tour, choice = np.zeros(n + 1, dtype=np.int64), np.zeros(n, dtype=np.int64)
    subset = full
    for position in range(n, 0, -1):
        tour[position] = i + 1
        choice[i] = k
        previous = before[subset, i, k]
        subset ^= 1 << i
        i, k = previous // most, previous % most
    return tour, choice, length
