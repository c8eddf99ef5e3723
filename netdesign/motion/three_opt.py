"""2-opt and 3-opt of closed tours, compiled: no reversal and no exchange of three legs makes the result shorter.

D (N, N) distances; t (N,) the closed tour, t[0] = 0; P[x, y] = D[t[x], t[y]] the distances in tour order, with
P[x, N] = P[x, 0]; P[N] the legs. P is scratch of more than N rows and columns.
"""

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import FAST, part

_GAIN = 1e-12  # relative: a move must gain more than rounding


@part(allocates=False)
def _length(D: Floats, t: Ints) -> float:
    total = 0.0
    for x in range(1, len(t) - 1):
        total += D[t[x], t[x + 1]]
    return total


@part(allocates=False)
def _reverse(t: Ints, low: int, high: int) -> None:
    """Reverse t[low..high] in place."""
    while low < high:
        t[low], t[high] = t[high], t[low]
        low += 1
        high -= 1


@part(allocates=False)
def _two_opt(D: Floats, t: Ints, threshold: float) -> None:
    """Reverse segments of ``t`` in place until no reversal gains more than ``threshold``."""
    N = len(t)
    improved = True
    while improved:
        improved = False
        for i in range(N - 2):
            for j in range(i + 2, N):
                after = t[j + 1] if j + 1 < N else t[0]
                gain = D[t[i], t[i + 1]] + D[t[j], after] - D[t[i], t[j]] - D[t[i + 1], after]
                if gain > threshold:
                    _reverse(t, i + 1, j)
                    improved = True


@part(fastmath=FAST | {"nnan"}, allocates=False)
def _three_opt_move(D: Floats, t: Ints, P: Floats, threshold: float) -> bool:
    """Apply one pure 3-opt move that gains more than ``threshold``; False when ``t`` is 3-optimal.

    Legs (i, i+1), (j, j+1), (k, k+1) are replaced; A = t[i+1..j], B = t[j+1..k]. The four reconnections:
    A' B', B A, B A', B' A (a prime reverses). All k of one (i, j) are tried at once, the best one is taken.
    """
    N = len(t)
    for x in range(N):
        for y in range(N):
            P[x, y] = D[t[x], t[y]]
        P[x, N] = P[x, 0]
    legs = P[N]
    for x in range(N):
        legs[x] = P[x, x + 1]
    one = np.uint64(1)  # unsigned indices: a signed one is tested for < 0, which keeps the loop scalar
    for i in range(N - 2):
        for j in range(i + 1, N - 1):
            base = P[i, i + 1] + P[j, j + 1] - threshold
            across, back, join = P[i, j] - base, P[i, j + 1] - base, P[i + 1, j + 1] - base
            row_i, row_i1, row_j, row_j1 = np.uint64(i), np.uint64(i + 1), np.uint64(j), np.uint64(j + 1)
            hits = 0  # counting vectorises, taking a minimum does not
            for x in range(N - 1 - j):
                k = np.uint64(x) + row_j1
                leg = legs[k]
                hits += int(
                    (across + P[row_i1, k] + P[row_j1, k + one] < leg)
                    | (back + P[row_i1, k] + P[row_j, k + one] < leg)
                    | (back + P[row_j, k] + P[row_i1, k + one] < leg)
                    | (join + P[row_i, k] + P[row_j, k + one] < leg)
                )
            if hits:
                _reconnect(t, P, i, j)
                return True
    return False


@part(allocates=False)
def _reconnect(t: Ints, P: Floats, i: int, j: int) -> None:
    """Apply to ``t`` the best of the reconnections of :func:`_three_opt_move` for (i, j)."""
    N = len(t)
    best, best_k, best_kind = np.inf, j + 1, 0
    for k in range(j + 1, N):
        leg = P[k, k + 1]
        lengths = (
            P[i, j] + P[i + 1, k] + P[j + 1, k + 1] - leg,
            P[i, j + 1] + P[i + 1, k] + P[j, k + 1] - leg,
            P[i, j + 1] + P[j, k] + P[i + 1, k + 1] - leg,
            P[i, k] + P[i + 1, j + 1] + P[j, k + 1] - leg,
        )
        for kind in range(4):
            if lengths[kind] < best:
                best, best_k, best_kind = lengths[kind], k, kind
    if best_kind == 0:
        _reverse(t, i + 1, j)
        _reverse(t, j + 1, best_k)
        return
    _reverse(t, i + 1, best_k)  # B' A'
    middle = i + best_k - j
    if best_kind != 3:
        _reverse(t, i + 1, middle)
    if best_kind != 2:
        _reverse(t, middle + 1, best_k)


@part(allocates=False)
def improve(D: Floats, t: Ints, P: Floats) -> float:
    """Make ``t`` 2-optimal and 3-optimal in place; return its length without the legs at node t[0]."""
    threshold = _GAIN * (_length(D, t) + 1e-300)
    _two_opt(D, t, threshold)
    while len(t) > 4 and _three_opt_move(D, t, P, threshold):
        _two_opt(D, t, threshold)
    return float(_length(D, t))
