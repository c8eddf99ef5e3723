"""The motion of one network, final: order, branches and rolls, exact joints inside their limits, every leg free.

1. Every branch at every roll is solved exactly and tested (``options``).
2. Order and options alternate from several starts, joint differences modulo whole turns (``joint_tour``); small
   problems are solved exactly (``exact_tour``).
3. The best options of every station, in all turns inside the limits, take part in the same alternation without the
   modulo: what comes out can be driven.
4. Every leg is tested; a colliding one is barred for its pair of branches and turns, and step 3 is repeated. Where
   that does not help, via points are put in, and the order is the best with them.
"""

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.frames import sphere_directions
from netdesign.model.results import Tour
from netdesign.model.scene import Part
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import RobotCell
from netdesign.motion.driven import leg_lengths, shorter_order, via_points
from netdesign.motion.exact_tour import exact_joint_tour
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_tour import NO_TURN, directions_tour, joint_tour, law_of, legs_along, work_for
from netdesign.motion.kinematics import forward
from netdesign.motion.legs import Legs, home_legs, turned_towards
from netdesign.motion.options import NO_POSES, StationOptions, exact_options, lifted
from netdesign.motion.tour import open_path

_ROUNDS = 20
_STARTS = 6
_EXACT_STATES = 80  # stations times options up to which the modulo problem is solved exactly
_EXACT_STATIONS = 10
_LIFTED_OPTIONS = 12  # options per station that take part in the lift
_BARRED = 1e3
_REPAIRS = 30


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The motion of a network; arrays in visiting order.

    Attributes:
        tour: order into the viewpoints given, joints (n, r) rad, length; None when stations are refused.
        world_from_cam: (n, 4, 4) m, from the joints.  viewpoints: (n, 2) rad.
        warnings: what was done about collisions.
        refused: index into the viewpoints given, and reason.
    """

    tour: Tour | None
    world_from_cam: Floats
    viewpoints: Floats
    warnings: tuple[str, ...] = ()
    refused: tuple[tuple[int, str], ...] = ()


@dataclass(frozen=True)
class _Problem:
    """Options and costs of one plan."""

    options: StationOptions
    law: Floats
    timed: bool
    barred: Floats

    def tour(self, start: Ints) -> tuple[float, Ints, Ints]:
        """Return (length, closed tour, choice) of the alternation from a closed tour (n + 1,)."""
        tour = start.copy()
        o = self.options
        work = work_for(*o.joints.shape)
        length = joint_tour(o.joints, o.count, o.label, self.barred, self.law, self.timed, tour, _ROUNDS, work)
        return float(length), tour, work.choice

    def legs(self, route: list[int]) -> list[Floats]:
        """Return the costs (K_i, K_j) of all legs between the stations that follow each other, without bars."""
        o, most = self.options, self.options.joints.shape[2]
        tour, found = np.array([0, *route]), np.empty((len(route), most, most))
        tour[1:] += 1
        legs_along(o.joints, o.count, tour, self.law, self.timed, found)
        return [found[p, : o.count[i], : o.count[j]] for p, (i, j) in enumerate(itertools.pairwise(route), start=1)]

    def exact(self) -> tuple[float, Ints, Ints]:
        """Return the same of the exact optimum."""
        o = self.options
        tour, choice, length = exact_joint_tour(o.joints, o.count, o.label, self.barred, self.law, self.timed)
        return float(length), tour, choice


def plan(
    cell: RobotCell,
    sphere: ViewingSphere,
    part: Part,
    viewpoints: Floats,
    motion: Literal["joint", "time"] = "joint",
    seed: int = 0,
) -> Plan:
    """Return the motion over viewpoints (n, 2), see ``plan_on``; builds or reads the joint map first."""
    return plan_on(JointMap.build(cell, sphere, part), viewpoints, motion, seed)


def plan_on(
    joint_map: JointMap,
    viewpoints: Floats,
    motion: Literal["joint", "time"] = "joint",
    seed: int = 0,
    given: Floats = NO_POSES,
) -> Plan:
    """Return the motion of the arm over n >= 1 stations in the best order found.

    Stations: poses ``given`` (e, 4, 4) world_from_cam, anywhere, which are kept, roll included; then viewpoints
    (n - e, 2 or 3) of the map's sphere. The tour's length is the sum of the driven legs: weighted rad, or s with the
    dwell at every station.
    """
    viewpoints = np.ascontiguousarray(viewpoints, dtype=np.float64)
    options = exact_options(joint_map, viewpoints, given)
    viewpoints = np.concatenate([joint_map.sphere.placed(given)[0], viewpoints[:, :2]])
    if options.refused:
        return Plan(tour=None, world_from_cam=np.zeros((0, 4, 4)), viewpoints=np.zeros((0, 2)), refused=options.refused)
    arm, timed = joint_map.arm, motion == "time"
    free = np.zeros((0, 0, 0, 0))
    modulo = _Problem(options, law_of(arm), timed, free)
    starts = _starts(modulo, viewpoints, seed)
    legs = Legs(joint_map)
    order, joints, notes = _repaired(modulo, starts, legs, arm.placed.lower, arm.placed.upper)
    if arm.cell.home is not None:
        joints = turned_towards(np.array(arm.cell.home), joints, arm.placed)
    vias, more, refused = via_points(legs, joints, order)
    if vias and not refused:
        again = shorter_order(legs, joints, vias, law_of(arm), timed)
        home = None if arm.cell.home is None else np.array(arm.cell.home)
        if home is None or not home_legs(legs, home, joints[again], order[again])[1]:
            order, joints = order[again], joints[again]
            vias, more, refused = via_points(legs, joints, order)
    if arm.cell.home is not None and not refused:
        from_home, refused = home_legs(legs, np.array(arm.cell.home), joints, order)
        more += from_home
    if refused:
        return Plan(tour=None, world_from_cam=np.zeros((0, 4, 4)), viewpoints=np.zeros((0, 2)), refused=refused)
    length = float(leg_lengths(joints, vias, law_of(arm), timed).sum())
    if timed:
        length += joint_map.arm.cell.dwell * len(joints)
    return Plan(
        tour=Tour(order=order, length=length, space=motion, joints=joints, vias=vias),
        world_from_cam=forward(arm.body.placements, arm.body.last_from_cam, joints),
        viewpoints=viewpoints[order],
        warnings=(*notes, *more),
    )


def _plain(law: Floats) -> Floats:
    """Return the law without wrapping: differences as they are driven."""
    flat = law.copy()
    flat[3] = NO_TURN
    return flat


def _starts(problem: _Problem, viewpoints: Floats, seed: int) -> list[tuple[float, Ints, Ints]]:
    """Return tours modulo whole turns, the best first; the exact optimum only where it can be had."""
    count, most = len(viewpoints), problem.options.joints.shape[2]
    first = directions_tour(sphere_directions(viewpoints))
    found = [problem.tour(first)]
    if count <= _EXACT_STATIONS and count * most <= _EXACT_STATES:
        found.append(problem.exact())
    rng = np.random.default_rng(seed)
    for attempt in range(_STARTS if count > 3 else 0):
        best = min(found, key=lambda item: item[0])[1]
        if attempt == 0:
            start = np.concatenate([[0], 1 + open_path(_nearest_options(problem))[0]]).astype(np.int64)
        else:
            cuts = np.sort(rng.choice(np.arange(1, count), size=2, replace=False))
            pieces = np.split(best[1:], cuts)
            start = np.concatenate([best[:1], *[pieces[index] for index in rng.permutation(3)]])
        found.append(problem.tour(start))
    found.sort(key=lambda item: item[0])
    return found


def _nearest_options(problem: _Problem) -> Floats:
    """Return the least cost (n, n) of a leg between two stations over all their options."""
    options = problem.options
    count = len(options.count)
    distance = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            distance[i, j] = distance[j, i] = problem.legs([i, j])[0].min()
    return distance


def _best_through(problem: _Problem, tour: Ints) -> list[list[int]]:
    """Return, per station, the options with the shortest tours through them for one order, the best first."""
    options = problem.options
    count, _, most = options.joints.shape
    forward_cost, backward = np.full((count, most), np.inf), np.full((count, most), np.inf)
    stations = tour[1:] - 1
    for costs, route in ((forward_cost, stations), (backward, stations[::-1])):
        costs[route[0], : options.count[route[0]]] = 0.0
        for i, j, legs in zip(route[:-1].tolist(), route[1:].tolist(), problem.legs(route.tolist()), strict=True):
            costs[j, : options.count[j]] = (costs[i, : options.count[i], None] + legs).min(axis=0)
    total = forward_cost + backward
    return [np.argsort(total[i, : options.count[i]], kind="stable")[:_LIFTED_OPTIONS].tolist() for i in range(count)]


def _repaired(
    modulo: _Problem, starts: list[tuple[float, Ints, Ints]], legs: Legs, lower: Floats, upper: Floats
) -> tuple[Ints, Floats, tuple[str, ...]]:
    """Return (order (n,), joints (n, r) in that order, notes): lifted, colliding legs barred while that helps."""
    candidates = []
    for _, tour, _ in starts[:2]:
        options = lifted(modulo.options, _best_through(modulo, tour), lower, upper)
        stations, turns = len(options.count), int(options.label.max()) + 1
        barred = np.zeros((stations, stations, turns, turns))
        problem = _Problem(options, _plain(modulo.law), modulo.timed, barred)
        candidates.append((problem.tour(tour), problem))
    (_, tour, _), problem = min(candidates, key=lambda item: item[0][0])
    fewest, best, attempts = len(tour), (tour[1:] - 1, np.zeros((0, 0))), 0
    for attempt in range(_REPAIRS + 1):
        order, joints, labels = _ordered(problem, tour)
        colliding = [leg for leg in range(len(order) - 1) if legs.contact(joints[leg], joints[leg + 1])]
        if attempt == 0 or len(colliding) < fewest:
            fewest, best, attempts = len(colliding), (order, joints), attempt
        if not colliding:
            break
        for leg in colliding:
            i, j, a, b = order[leg], order[leg + 1], labels[leg], labels[leg + 1]
            problem.barred[i, j, a, b] = problem.barred[j, i, b, a] = _BARRED
    notes = () if attempts == 0 else (f"tour re-planned {attempts} times around legs that collide",)
    return *best, notes


def _ordered(problem: _Problem, tour: Ints) -> tuple[Ints, Floats, Ints]:
    """Return (order (n,), joints (n, r), labels (n,)) of the lifted problem, the order also the best for its joints."""
    options = problem.options
    length, tour, choice = problem.tour(tour)
    while True:
        stations = np.arange(len(choice))
        joints, labels = options.joints[stations, :, choice], options.label[stations, choice]
        order, shorter = open_path(_distances(joints, labels, problem))
        if shorter >= length * (1.0 - 1e-9):
            break
        length, tour, choice = problem.tour(np.concatenate([[0], order + 1]).astype(np.int64))
    order = tour[1:] - 1
    return order, np.ascontiguousarray(joints[order]), labels[order]


def _distances(joints: Floats, labels: Ints, problem: _Problem) -> Floats:
    """Return the cost (n, n) of the legs between joints (n, r), barred legs included."""
    change, r = np.abs(joints[:, None] - joints), joints.shape[1]
    if problem.timed:
        longest, hardest = (change * problem.law[1, :r]).max(axis=2), (change * problem.law[2, :r]).max(axis=2)
        ramp = hardest / np.where(longest > 0, longest, 1.0)
        cost = np.where(longest**2 >= hardest, longest + ramp, 2.0 * np.sqrt(hardest))
    else:
        cost = np.sqrt(((problem.law[0, :r] * change) ** 2).sum(axis=2))
    stations = np.arange(len(joints))
    cost = cost + problem.barred[stations[:, None], stations, labels[:, None], labels]
    np.fill_diagonal(cost, 0.0)
    return np.asarray(cost)
