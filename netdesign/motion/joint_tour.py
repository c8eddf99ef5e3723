"""Order and joint option together: the generalised travelling salesman of the camera tour, compiled.

Every station has up to K joint options (branch, roll); a tour picks an order and one option each. The search
alternates: with the order fixed, dynamic programming picks the best options exactly; with the options fixed, 3-opt
improves the order (``motion.tour``). The first round gains nearly all there is; a plan takes as many as it needs, from
several starts.

A leg costs (law "joint") the weighted norm of the joint differences, or (law "time") the synchronised trapezoid of
``motion.timing``. Differences of joints that wrap are taken modulo whole turns: a lower bound that the plan lifts into
the real ranges. Sources: the source paper's D(V_i, V_j); the scheme is Bellman's dynamic programming.

Kernels: options (n, r, K), count (n,), law (4, r): lambda, 1/speed, 1/acceleration, and 2 pi where the joint wraps
(else NO_TURN, so long that it is never taken); timed: which law. K is a multiple of LANES. label (n, K) and
barred (n, n, B, B): what a leg from station i, option labelled a to station j, option labelled b costs on top (a plan
bars legs that collide); barred of size 0: nothing. work: scratch, allocated once for many networks.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import FAST, entry, part
from netdesign.motion.cell import ArmCell
from netdesign.motion.joint_lookup import LANES, MapArrays, options_of
from netdesign.motion.robot import Chain
from netdesign.motion.three_opt import improve

NO_TURN = 1e9
_ROUNDS = 1  # more rounds shorten the tours by 0.3 % on average and cost half as much again
_TINY = 1e-30
MOST_JOINTS = 7
_NO_NAN = FAST | {"nnan"}


def law_of(arm: ArmCell) -> Floats:
    """Return the law (4, MOST_JOINTS) of an arm: lambda, 1/speed, 1/acceleration, 2 pi where a joint wraps.

    Joints that an arm does not have cost nothing.
    """
    return chain_law(arm.placed, arm.weights)


def chain_law(placed: Chain, weights: Floats) -> Floats:
    """Return the same of a chain and lambda (r,)."""
    count = len(placed)
    law = np.zeros((4, MOST_JOINTS))
    law[:, :count] = weights, 1.0 / placed.speed, 1.0 / placed.acceleration, 2.0 * np.pi * placed.wraps
    law[3, law[3] == 0.0] = NO_TURN
    return law


@part(fastmath=_NO_NAN, allocates=False)
def _apart(first, second, turn):  # type: ignore[no-untyped-def]
    """Return how far a joint has to turn."""
    d = abs(first - second)
    return min(d, abs(turn - d))


@entry(fastmath=_NO_NAN)
def legs_along(options, count, tour, law, timed, out):  # type: ignore[no-untyped-def]
    """Write the costs of all legs between the stations that follow each other on a tour into out (n, K, K).

    out[p, k, c]: from option k of the p-th station to option c of the next, p from 1; whole vectors are written, up to
    LANES - 1 columns more, of no meaning. The joints are written out, so that the compiler keeps them in registers and
    runs over four options at once: a loop over them is four times slower.
    """
    last = options.shape[1] - 1
    b, c, d, e, f, g = min(1, last), min(2, last), min(3, last), min(4, last), min(5, last), min(6, last)
    ta, tb, tc, td, te, tf, tg = law[3, 0], law[3, 1], law[3, 2], law[3, 3], law[3, 4], law[3, 5], law[3, 6]
    wa, wb, wc, wd, we, wf, wg = law[0, 0], law[0, 1], law[0, 2], law[0, 3], law[0, 4], law[0, 5], law[0, 6]
    va, vb, vc, vd, ve, vf, vg = law[1, 0], law[1, 1], law[1, 2], law[1, 3], law[1, 4], law[1, 5], law[1, 6]
    sa, sb, sc, sd, se, sf, sg = law[2, 0], law[2, 1], law[2, 2], law[2, 3], law[2, 4], law[2, 5], law[2, 6]
    for p in range(1, tour.shape[0] - 1):
        i, j = tour[p] - 1, tour[p + 1] - 1
        lanes = (count[j] + LANES - 1) // LANES * LANES
        for k in range(count[i]):
            qa, qb, qc, qd = options[i, 0, k], options[i, b, k], options[i, c, k], options[i, d, k]
            qe, qf, qg = options[i, e, k], options[i, f, k], options[i, g, k]
            if timed:
                for x in range(lanes):
                    da, db = _apart(options[j, 0, x], qa, ta), _apart(options[j, b, x], qb, tb)
                    dc, dd = _apart(options[j, c, x], qc, tc), _apart(options[j, d, x], qd, td)
                    de, df = _apart(options[j, e, x], qe, te), _apart(options[j, f, x], qf, tf)
                    dg = _apart(options[j, g, x], qg, tg)
                    longest = max(
                        max(max(va * da, vb * db), max(vc * dc, vd * dd)), max(max(ve * de, vf * df), vg * dg)
                    )
                    hardest = max(
                        max(max(sa * da, sb * db), max(sc * dc, sd * dd)), max(max(se * de, sf * df), sg * dg)
                    )
                    cruise = longest + hardest / max(longest, _TINY)
                    out[p, k, x] = cruise if longest * longest >= hardest else 2.0 * math.sqrt(hardest)
            else:
                for x in range(lanes):
                    da, db = wa * _apart(options[j, 0, x], qa, ta), wb * _apart(options[j, b, x], qb, tb)
                    dc, dd = wc * _apart(options[j, c, x], qc, tc), wd * _apart(options[j, d, x], qd, td)
                    de, df = we * _apart(options[j, e, x], qe, te), wf * _apart(options[j, f, x], qf, tf)
                    dg = wg * _apart(options[j, g, x], qg, tg)
                    out[p, k, x] = math.sqrt(da * da + db * db + dc * dc + dd * dd + de * de + df * df + dg * dg)


class Work(NamedTuple):
    """Scratch of the kernels for up to n stations of up to K options, from ``work_for``."""

    costs: Any
    legs: Any
    back: Any
    distances: Any
    pairs: Any
    picked: Any
    all: Any
    itself: Any
    choice: Any
    trial: Any


def work_for(n: int, r: int, most: int) -> Work:
    """Return scratch for n stations of at most ``most`` options of r joints."""
    wide = (max(n, most) + LANES - 1) // LANES * LANES
    return Work(
        np.zeros((2, wide)), np.zeros((max(n, 2), wide, wide)), np.zeros((n + 1, wide), dtype=np.int64),
        np.zeros((n + 1, n + 1)), np.zeros((n + 2, n + 2)), np.zeros((1, r, wide)), np.zeros(1, dtype=np.int64),
        np.array([0, 1, 1]), np.zeros(n, dtype=np.int64), np.zeros(n + 1, dtype=np.int64),
    )  # fmt: skip


@part(allocates=False)
def choose_options(options, count, label, barred, tour, law, timed, choice, work):  # type: ignore[no-untyped-def]
    """Write the best option of every station into choice (n,) for the closed tour (n + 1,) with its dummy in front.

    Exact for that order, dynamic programming from the first station on. Returns the length.
    """
    costs, legs, back = work.costs, work.legs, work.back
    n = options.shape[0]
    legs_along(options, count, tour, law, timed, legs)
    for k in range(count[tour[1] - 1]):
        costs[0, k] = 0.0
    for position in range(1, n):
        i, j = tour[position] - 1, tour[position + 1] - 1
        old, new = (position - 1) & 1, position & 1
        if barred.size:
            for k in range(count[i]):
                for c in range(count[j]):
                    legs[position, k, c] += barred[i, j, label[i, k], label[j, c]]
        for c in range(count[j]):
            shortest, best = costs[old, 0] + legs[position, 0, c], 0
            for k in range(1, count[i]):
                value = costs[old, k] + legs[position, k, c]
                if value < shortest:
                    shortest, best = value, k
            costs[new, c] = shortest
            back[position, c] = best
    last = tour[n] - 1
    row = (n - 1) & 1
    best = 0
    for k in range(1, count[last]):
        if costs[row, k] < costs[row, best]:
            best = k
    length = costs[row, best]
    for position in range(n - 1, -1, -1):
        choice[tour[position + 1] - 1] = best
        best = back[position, best] if position else 0
    return length


@part(allocates=False)
def _chosen_distances(options, label, barred, choice, law, timed, work):  # type: ignore[no-untyped-def]
    """Write the leg costs between the chosen options into work.distances, the dummy in front."""
    picked, legs, distances = work.picked, work.legs, work.distances
    n, r = options.shape[0], options.shape[1]
    for i in range(n):
        for a in range(r):
            picked[0, a, i] = options[i, a, choice[i]]
    work.all[0] = n
    legs_along(picked, work.all, work.itself, law, timed, legs)
    for i in range(n):
        distances[0, i + 1] = distances[i + 1, 0] = 0.0
        for j in range(n):
            distances[i + 1, j + 1] = legs[1, i, j]
            if barred.size:
                distances[i + 1, j + 1] += barred[i, j, label[i, choice[i]], label[j, choice[j]]]


@entry()
def joint_tour(options, count, label, barred, law, timed, tour, rounds, work):  # type: ignore[no-untyped-def]
    """Improve the closed tour (n + 1,) with its dummy in front, in place; return its length, the choice in work.choice.

    Args: see the module; options (n, r, K) rad; count (n,) >= 1; tour: any start, tour[0] = 0, station + 1; rounds: how
    often order and options take turns at most; work: for at least as many stations and options.
    """
    n = options.shape[0]
    trial = work.trial[: n + 1]
    for x in range(n + 1):
        trial[x] = tour[x]
    best = np.inf
    for turn in range(rounds + 1):
        best = choose_options(options, count, label, barred, trial, law, timed, work.choice, work)
        for x in range(n + 1):
            tour[x] = trial[x]
        if turn == rounds or n < 3:
            break
        _chosen_distances(options, label, barred, work.choice, law, timed, work)
        if improve(work.distances, trial, work.pairs) > best * (1.0 - 1e-9):
            break
    return best


@part()
def directions_tour(directions):  # type: ignore[no-untyped-def]
    """Return the closed tour (n + 1,), dummy in front, that goes from unit direction (n, 3) to nearest direction."""
    n = directions.shape[0]
    tour = np.empty(n + 1, dtype=np.int64)
    for i in range(n + 1):
        tour[i] = i
    for position in range(2, n + 1):
        here = tour[position - 1] - 1
        x, y, z = directions[here, 0], directions[here, 1], directions[here, 2]
        nearest, best = position, -2.0
        for candidate in range(position, n + 1):
            there = tour[candidate] - 1
            cosine = x * directions[there, 0] + y * directions[there, 1] + z * directions[there, 2]
            if cosine > best:
                nearest, best = candidate, cosine
        tour[position], tour[nearest] = tour[nearest], tour[position]
    return tour


@part()
def _options_tour(
    options: Floats, count: Ints, directions: Floats, label: Ints, barred: Floats, law: Floats, timed: bool, work: Work
) -> float:
    """Return the search's joint tour of n >= 1 stations whose options (n, r, K) are known, without dwell.

    It starts from the order that goes to the nearest of the unit directions (n, 3).
    """
    tour = directions_tour(directions)
    length: float = joint_tour(options, count, label, barred, law, timed, tour, np.int64(_ROUNDS), work)
    return length


@entry()
def options_tour(
    options: Floats, count: Ints, directions: Floats, label: Ints, barred: Floats, law: Floats, timed: bool, work: Work
) -> float:
    """Return the search's joint tour of n >= 1 stations whose options (n, r, K) are known, without dwell."""
    length: float = _options_tour(options, count, directions, label, barred, law, timed, work)
    return length


class SearchWork(NamedTuple):
    """Scratch of ``network_tour``, from ``search_work_for``."""

    directions: Any
    options: Any
    count: Any
    block: Any
    label: Any
    barred: Any


def search_work_for(arrays: MapArrays, n: int) -> tuple[SearchWork, Work]:
    """Return scratch of ``network_tour`` for up to n viewpoints over a map: of its own, and the tour's."""
    r = arrays.joints.shape[4]
    own = SearchWork(
        np.zeros((n, 3)), np.zeros((n, r, arrays.most)), np.zeros(n, dtype=np.int64),
        np.zeros(arrays.turns.shape[0], dtype=np.float32), np.zeros((0, 0), dtype=np.int64), np.zeros((0, 0, 0, 0)),
    )  # fmt: skip
    return own, work_for(n, r, arrays.most)


@part()
def network_tour(arrays, law, timed, dwell, viewpoints, own, work):  # type: ignore[no-untyped-def]
    """Return (f2, refused) of one network in the search: its joint tour from the map, and the stations out of reach.

    Args: arrays of the JointMap; law (4, r); timed and dwell (s): time instead of joint length; viewpoints (n, 2);
    own, work: from ``search_work_for``. Stations without a free option are left out of the tour and counted.
    """
    n = viewpoints.shape[0]
    for i in range(n):
        flat = math.cos(viewpoints[i, 1])
        own.directions[i, 0] = flat * math.cos(viewpoints[i, 0])
        own.directions[i, 1] = flat * math.sin(viewpoints[i, 0])
        own.directions[i, 2] = math.sin(viewpoints[i, 1])
    kept = options_of(arrays, own.directions[:n], own.block, own.options, own.count)
    refused = n - kept
    length = 0.0
    if kept > 1:
        length = _options_tour(
            own.options[:kept], own.count[:kept], own.directions[:kept], own.label, own.barred, law, timed, work
        )
    return (length + dwell * n if timed else length), refused
