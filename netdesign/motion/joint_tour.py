"""Order and joint option together: the generalised travelling salesman of the camera tour, compiled.

Every station has up to K joint options (branch, roll); a tour picks an order and one option each. The search
alternates: with the order fixed, dynamic programming picks the best options exactly; with the options fixed, 3-opt
improves the order (``motion.tour``). The first round
gains nearly all there is; a plan takes as many as it needs, from several starts.

A leg costs (law "joint") the weighted norm of the joint differences, or (law "time") the synchronised trapezoid of
``motion.timing``. Differences of joints that wrap are taken modulo whole turns: a lower bound that the plan lifts into
the real ranges. Sources: the source paper's D(V_i, V_j); the scheme is Bellman's dynamic programming.

Kernels: options (n, r, K), count (n,), law (4, r): lambda, 1/speed, 1/acceleration, and 2 pi where the joint wraps
(else NO_TURN, so long that it is never taken); timed: which law. label (n, K) and barred (n, n, B, B): what a leg from
station i, option labelled a to station j, option labelled b costs on top (a plan bars legs that collide); barred of
size 0: nothing.
"""

import math

import numpy as np
from numba import njit

from netdesign.model.arrays import Floats
from netdesign.motion.cell import ArmCell
from netdesign.motion.joint_lookup import options_at
from netdesign.motion.tour import _improve

NO_TURN = 1e9
_ROUNDS = 1  # more rounds shorten the tours by 0.3 % on average and cost half as much again
_FAST = {"reassoc", "contract", "arcp", "nsz", "nnan", "ninf"}


def law_of(arm: ArmCell) -> Floats:
    """Return the law (4, r) of an arm: lambda, 1/speed, 1/acceleration, 2 pi where a joint wraps."""
    placed = arm.placed
    turn = np.where(placed.wraps, 2.0 * np.pi, NO_TURN)
    return np.stack([arm.weights, 1.0 / placed.speed, 1.0 / placed.acceleration, turn])


@njit(cache=True, error_model="numpy", fastmath=_FAST)
def legs_from(options, i, k, j, count, law, timed, sums, tops, out):  # type: ignore[no-untyped-def]
    """Write the cost of the legs from option k of station i to the first ``count`` options of j into out (K,)."""
    r = options.shape[1]
    for c in range(count):
        sums[c] = 0.0
        tops[c] = 0.0
    for a in range(r):
        here = options[i, a, k]
        turn = law[3, a]
        if timed:
            slow, soft = law[1, a], law[2, a]
            for c in range(count):
                d = abs(options[j, a, c] - here)
                d = min(d, abs(turn - d))
                sums[c] = max(sums[c], d * slow)
                tops[c] = max(tops[c], d * soft)
        else:
            weight = law[0, a]
            for c in range(count):
                d = abs(options[j, a, c] - here)
                d = weight * min(d, abs(turn - d))
                sums[c] += d * d
    if timed:
        for c in range(count):
            longest, hardest = sums[c], tops[c]
            if longest * longest >= hardest:
                out[c] = longest + (hardest / longest if longest > 0.0 else 0.0)
            else:
                out[c] = 2.0 * math.sqrt(hardest)
    else:
        for c in range(count):
            out[c] = math.sqrt(sums[c])


@njit(cache=True, error_model="numpy")
def choose_options(options, count, label, barred, tour, law, timed, choice, work):  # type: ignore[no-untyped-def]
    """Write the best option of every station into choice (n,) for the closed tour (n + 1,) with its dummy in front.

    Exact for that order, dynamic programming from the first station on. Returns the length. work: scratch from
    ``scratch``.
    """
    costs, leg, sums, tops, back = work
    n = options.shape[0]
    first = tour[1] - 1
    for k in range(count[first]):
        costs[0, k] = 0.0
    for position in range(1, n):
        i, j = tour[position] - 1, tour[position + 1] - 1
        old, new = costs[(position - 1) & 1], costs[position & 1]
        for c in range(count[j]):
            new[c] = np.inf
        for k in range(count[i]):
            legs_from(options, i, k, j, count[j], law, timed, sums, tops, leg)
            if barred.size:
                for c in range(count[j]):
                    leg[c] += barred[i, j, label[i, k], label[j, c]]
            for c in range(count[j]):
                value = old[k] + leg[c]
                if value < new[c]:
                    new[c] = value
                    back[position, c] = k
    last = tour[n] - 1
    row = costs[(n - 1) & 1]
    best = 0
    for k in range(1, count[last]):
        if row[k] < row[best]:
            best = k
    length = row[best]
    for position in range(n - 1, -1, -1):
        choice[tour[position + 1] - 1] = best
        best = back[position, best] if position else 0
    return length


@njit(cache=True, error_model="numpy")
def scratch(n, most):  # type: ignore[no-untyped-def]
    """Return the working arrays of ``choose_options`` for n stations of at most ``most`` options."""
    back = np.zeros((max(n, 1), most), dtype=np.int64)
    return np.empty((2, most)), np.empty(most), np.empty(most), np.empty(most), back


@njit(cache=True, error_model="numpy")
def _chosen_distances(options, label, barred, choice, law, timed, picked, work, distances):  # type: ignore[no-untyped-def]
    """Write the leg costs between the chosen options into distances (n + 1, n + 1), the dummy in front."""
    _, leg, sums, tops, _ = work
    n, r = options.shape[0], options.shape[1]
    for i in range(n):
        for a in range(r):
            picked[0, a, i] = options[i, a, choice[i]]
    for i in range(n):
        legs_from(picked, 0, i, 0, i, law, timed, sums, tops, leg)
        for j in range(i):
            if barred.size:
                leg[j] += barred[i, j, label[i, choice[i]], label[j, choice[j]]]
            distances[i + 1, j + 1] = leg[j]
            distances[j + 1, i + 1] = leg[j]


@njit(cache=True, error_model="numpy")
def joint_tour(options, count, label, barred, law, timed, tour, rounds):  # type: ignore[no-untyped-def]
    """Return (length, choice (n,)) and improve the closed tour (n + 1,) with its dummy in front, in place.

    Args: see the module; options (n, r, K) rad; count (n,) >= 1; tour: any start, tour[0] = 0, station + 1; rounds: how
    often order and options take turns at most.
    """
    n, r, most = options.shape
    work = scratch(n, max(most, n))
    distances, pairs = np.zeros((n + 1, n + 1)), np.empty((n + 1, n + 2))
    picked = np.empty((1, r, n))
    choice = np.zeros(n, dtype=np.int64)
    trial = tour.copy()
    best = np.inf
    for turn in range(rounds + 1):
        best = choose_options(options, count, label, barred, trial, law, timed, choice, work)
        for x in range(n + 1):
            tour[x] = trial[x]
        if turn == rounds or n < 3:
            break
        _chosen_distances(options, label, barred, choice, law, timed, picked, work, distances)
        if _improve(distances, trial, pairs) > best * (1.0 - 1e-9):
            break
    return best, choice


@njit(cache=True, error_model="numpy")
def directions_tour(viewpoints):  # type: ignore[no-untyped-def]
    """Return the closed tour (n + 1,), dummy in front, that goes from viewpoint (n, 2) to nearest viewpoint."""
    n = viewpoints.shape[0]
    unit = np.empty((n, 3))
    tour = np.empty(n + 1, dtype=np.int64)
    tour[0] = 0
    for i in range(n):
        flat = math.cos(viewpoints[i, 1])
        unit[i, 0], unit[i, 1] = flat * math.cos(viewpoints[i, 0]), flat * math.sin(viewpoints[i, 0])
        unit[i, 2] = math.sin(viewpoints[i, 1])
        tour[i + 1] = i + 1
    for position in range(2, n + 1):
        here = tour[position - 1] - 1
        nearest, best = position, -2.0
        for candidate in range(position, n + 1):
            there = tour[candidate] - 1
            cosine = unit[here, 0] * unit[there, 0] + unit[here, 1] * unit[there, 1] + unit[here, 2] * unit[there, 2]
            if cosine > best:
                nearest, best = candidate, cosine
        tour[position], tour[nearest] = tour[nearest], tour[position]
    return tour


@njit(cache=True, error_model="numpy")
def network_tour(arrays, law, timed, dwell, viewpoints):  # type: ignore[no-untyped-def]
    """Return (f2, refused) of one network in the search: its joint tour from the map, and the stations out of reach.

    Args: arrays of the JointMap; law (4, r); timed and dwell (s): time instead of joint length; viewpoints (n, 2).
    Stations without a free option are left out of the tour and counted.
    """
    n, r = viewpoints.shape[0], arrays.joints.shape[4]
    options = np.empty((n, r, arrays.most))
    count = np.empty(n, dtype=np.int64)
    seen = np.empty((n, 2))
    kept = 0
    for i in range(n):
        found = options_at(arrays, viewpoints[i, 0], viewpoints[i, 1], options[kept])
        if found:
            count[kept] = found
            seen[kept, 0], seen[kept, 1] = viewpoints[i, 0], viewpoints[i, 1]
            kept += 1
    refused = n - kept
    if kept < 2:
        return (dwell * n if timed else 0.0), refused
    label, barred = np.empty((0, 0), dtype=np.int64), np.empty((0, 0, 0, 0))
    tour = directions_tour(seen[:kept])
    length, _ = joint_tour(options[:kept], count[:kept], label, barred, law, timed, tour, _ROUNDS)
    return (length + dwell * n if timed else length), refused
