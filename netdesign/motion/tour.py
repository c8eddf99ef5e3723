"""The order in which the stations are visited: shortest open paths over symmetric distances.

An open path is a closed tour with one more node, the dummy, at distance zero from all others: the two legs at the
dummy are the free ends. In the search every network gets nearest neighbour and 3-opt, the source paper's heuristic;
what is reported gets :func:`open_path`, exact up to twelve stations.

Kernels: D (N, N) distances with the dummy as node 0, N = n + 1; t (N,) the closed tour, t[0] = 0;
P[x, y] = D[t[x], t[y]] the distances in tour order.
"""

import numpy as np

from netdesign.errors import InputError
from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import FAST, entry, part

EXACT_UP_TO = 12
KICKS = 1000
_GAIN = 1e-12  # relative: a move must gain more than rounding


@part()
def _with_dummy(distance: Floats) -> Floats:
    """Return D (n+1, n+1): ``distance`` with the dummy node in front."""
    n = len(distance)
    padded = np.zeros((n + 1, n + 1))
    for a in range(n):  # loops: slice assignments take numba seconds to compile
        for b in range(n):
            padded[a + 1, b + 1] = distance[a, b]
    return padded


@part()
def _without_dummy(t: Ints) -> Ints:
    """Return the order (n,) of the closed tour ``t`` without its dummy."""
    order = np.empty(len(t) - 1, np.int64)
    for position in range(len(order)):
        order[position] = t[position + 1] - 1
    return order


@part()
def _nearest_neighbour(D: Floats, first: int) -> Ints:
    """Return the closed tour that starts dummy, ``first`` and always goes on to the nearest node left."""
    N = len(D)
    t = np.arange(N)
    t[1], t[first] = first, 1
    for position in range(2, N):
        here = t[position - 1]
        nearest = position
        for candidate in range(position + 1, N):
            if D[here, t[candidate]] < D[here, t[nearest]]:
                nearest = candidate
        t[position], t[nearest] = t[nearest], t[position]
    return t


@part()
def _length(D: Floats, t: Ints) -> float:
    total = 0.0
    for x in range(1, len(t) - 1):
        total += D[t[x], t[x + 1]]
    return total


@part()
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
                    low, high = i + 1, j
                    while low < high:
                        t[low], t[high] = t[high], t[low]
                        low += 1
                        high -= 1
                    improved = True


@part(fastmath=FAST | {"nnan"})
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
    legs = np.empty(N)
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


@part()
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
    old = t[i + 1 : best_k + 1].copy()
    a, total = j - i, best_k - i
    b = total - a
    for x in range(total):
        if best_kind == 0:
            source = a - 1 - x if x < a else total - 1 - (x - a)
        elif best_kind == 1:
            source = a + x if x < b else x - b
        elif best_kind == 2:
            source = a + x if x < b else a - 1 - (x - b)
        else:
            source = total - 1 - x if x < b else x - b
        t[i + 1 + x] = old[source]


@part()
def _improve(D: Floats, t: Ints, P: Floats) -> float:
    """Make ``t`` 2-optimal and 3-optimal in place; return its open length."""
    threshold = _GAIN * (_length(D, t) + 1e-300)
    _two_opt(D, t, threshold)
    while len(t) > 4 and _three_opt_move(D, t, P, threshold):
        _two_opt(D, t, threshold)
    return float(_length(D, t))


@entry()
def nearest_neighbour_3opt(distance: Floats) -> tuple[Ints, float]:
    """Return (order (n,), length) of the source paper's heuristic: nearest neighbour from node 0, then full 3-opt.

    Args:
        distance: (n, n) symmetric, any unit, finite.
    """
    D = _with_dummy(distance)
    t = _nearest_neighbour(D, 1) if len(D) > 1 else np.arange(len(D))
    length = _improve(D, t, np.empty((len(D), len(D) + 1)))
    return _without_dummy(t), length


@entry()
def path_length(positions: Floats) -> float:
    """Return the length of the heuristic path over positions (n, d), Euclidean distances."""
    return float(heuristic_length(positions))


@part()
def heuristic_length(positions: Floats) -> float:
    """Return what :func:`path_length` returns, for kernels."""
    n, axes = positions.shape
    D = np.zeros((n + 1, n + 1))
    for a in range(n):
        for b in range(a):
            square = 0.0
            for axis in range(axes):
                square += (positions[a, axis] - positions[b, axis]) ** 2
            D[a + 1, b + 1] = D[b + 1, a + 1] = np.sqrt(square)
    if n < 2:
        return 0.0
    return float(_improve(D, _nearest_neighbour(D, 1), np.empty((n + 1, n + 2))))


@entry()
def held_karp(distance: Floats) -> tuple[Ints, float]:
    """Return (order (n,), length) of the shortest open path, exact, by dynamic programming over subsets.

    Time n² 2ⁿ, memory n 2ⁿ doubles: meant for n <= 13. Source: M. Held, R. M. Karp, J. SIAM 10(1), 1962.
    """
    n = len(distance)
    full = (1 << n) - 1
    shortest = np.empty((1 << n, n))  # loops: np.full and argmin take numba long to compile
    for subset in range(1 << n):
        for last in range(n):
            shortest[subset, last] = np.inf
    for last in range(n):
        shortest[1 << last, last] = 0.0
    for subset in range(1, 1 << n):
        for last in range(n):
            here = shortest[subset, last]
            if here == np.inf:
                continue
            for following in range(n):
                if not subset >> following & 1:
                    longer = here + distance[last, following]
                    if longer < shortest[subset | 1 << following, following]:
                        shortest[subset | 1 << following, following] = longer
    order = np.zeros(n, np.int64)
    last = 0
    for candidate in range(n):
        if shortest[full, candidate] < shortest[full, last]:
            last = candidate
    length = shortest[full, last]
    subset = full
    for position in range(n - 1, -1, -1):
        order[position] = last
        subset ^= 1 << last
        best = np.inf
        for previous in range(n):
            if subset >> previous & 1 and shortest[subset, previous] + distance[previous, order[position]] < best:
                best = shortest[subset, previous] + distance[previous, order[position]]
                last = previous
    return order, length


@entry()
def iterated_local_search(distance: Floats, cuts: Ints) -> tuple[Ints, float]:
    """Return (order (n,), length): the best 3-optimal path from every start, then one double bridge per ``cuts`` row.

    A double bridge turns the tour A B C D into A D C B, which 3-opt cannot undo in one move; it is kept when the
    repaired path is no longer.

    Args:
        distance: (n, n) symmetric.
        cuts: (kicks, 3) ascending positions 1 to n where B, C and D start.
    """
    D = _with_dummy(distance)
    N = len(D)
    P = np.empty((N, N + 1))
    best = np.arange(N)
    best_length = _improve(D, best, P)
    for first in range(1, N):
        t = _nearest_neighbour(D, first)
        length = _improve(D, t, P)
        if length < best_length:
            best, best_length = t, length
    for kick in range(len(cuts)):
        b, c, d = cuts[kick, 0], cuts[kick, 1], cuts[kick, 2]
        t = best.copy()
        for x in range(b, N):
            y = x - b
            if y < N - d:
                t[x] = best[d + y]
            elif y < N - c:
                t[x] = best[c + y - (N - d)]
            else:
                t[x] = best[b + y - (N - c)]
        length = _improve(D, t, P)
        if length <= best_length:
            best, best_length = t, length
    return _without_dummy(best), best_length


def open_path(distance: Floats, seed: int = 0) -> tuple[Ints, float]:
    """Return (order (n,), length) for the report: exact up to 12 stations, iterated local search beyond.

    Args:
        distance: (n, n) symmetric, finite, zero diagonal, any unit.
        seed: of the search beyond 12 stations.

    Raises:
        InputError: when the matrix is not square, not finite or not symmetric.
    """
    distance = np.ascontiguousarray(distance, dtype=np.float64)
    if distance.ndim != 2 or distance.shape[0] != distance.shape[1] or len(distance) == 0:
        raise InputError(f"distance: expected a square matrix, found shape {distance.shape}")
    if not (np.isfinite(distance).all() and np.allclose(distance, distance.T, rtol=1e-9, atol=1e-15)):
        raise InputError("distance: expected a finite symmetric matrix")
    if len(distance) <= EXACT_UP_TO:
        order, length = held_karp(distance)
    else:
        scores = np.random.default_rng(seed).random((KICKS, len(distance)))
        cuts = np.sort(np.argsort(scores, axis=1)[:, :3], axis=1) + 1
        order, length = iterated_local_search(distance, cuts)
    return order, float(length)
