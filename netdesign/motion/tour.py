"""The order in which the stations are visited: shortest open paths over symmetric distances.

An open path is a closed tour with one more node, the dummy, at distance zero from all others: the two legs at the
dummy are the free ends. In the search every network gets nearest neighbour and 3-opt, the source paper's heuristic;
what is reported gets :func:`open_path`, exact up to twelve stations.

Kernels: D, t and P as in :mod:`netdesign.motion.three_opt`, with the dummy as node 0, N = n + 1.
"""

import numpy as np

from netdesign.errors import InputError
from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import entry, part
from netdesign.motion.three_opt import improve

EXACT_UP_TO = 12
KICKS = 1000


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


@entry()
def nearest_neighbour_3opt(distance: Floats) -> tuple[Ints, float]:
    """Return (order (n,), length) of the source paper's heuristic: nearest neighbour from node 0, then full 3-opt.

    Args:
        distance: (n, n) symmetric, any unit, finite.
    """
    D = _with_dummy(distance)
    t = _nearest_neighbour(D, 1) if len(D) > 1 else np.arange(len(D))
    length = improve(D, t, np.empty((len(D) + 1, len(D) + 1)))
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
    return float(improve(D, _nearest_neighbour(D, 1), np.empty((n + 2, n + 2))))


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
    P = np.empty((N + 1, N + 1))
    best = np.arange(N)
    best_length = improve(D, best, P)
    for first in range(1, N):
        t = _nearest_neighbour(D, first)
        length = improve(D, t, P)
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
        length = improve(D, t, P)
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
