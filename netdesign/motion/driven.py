"""A tour as it is driven: via points where straight legs collide, its length, its order once these are known."""

import itertools

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.motion.legs import Legs
from netdesign.motion.tour import open_path

_ROUNDS = 300
_BARRED = 1e3


def leg_lengths(joints: Floats, vias: dict[int, Floats], law: Floats, timed: bool) -> Floats:
    """Return the cost (n - 1,) of driving joints (n, r) in order over the via points, leg by leg, without dwell."""
    r = joints.shape[1]
    lengths = np.zeros(len(joints) - 1)
    for leg in range(len(joints) - 1):
        change = np.abs(
            np.diff(
                np.concatenate([joints[leg : leg + 1], vias.get(leg, joints[:0]), joints[leg + 1 : leg + 2]]), axis=0
            )
        )
        if not timed:
            lengths[leg] = np.sqrt(((law[0, :r] * change) ** 2).sum(axis=1)).sum()
            continue
        longest, hardest = (change * law[1, :r]).max(axis=1), (change * law[2, :r]).max(axis=1)
        ramp = hardest / np.where(longest > 0, longest, 1.0)
        lengths[leg] = np.where(longest**2 >= hardest, longest + ramp, 2.0 * np.sqrt(hardest)).sum()
    return lengths


def via_points(
    legs: Legs, joints: Floats, order: Ints
) -> tuple[dict[int, Floats], tuple[str, ...], tuple[tuple[int, str], ...]]:
    """Return via points of the legs that still collide, what is to be said, and stations that cannot be left."""
    vias: dict[int, Floats] = {}
    notes: list[str] = []
    refused: list[tuple[int, str]] = []
    for leg in range(len(joints) - 1):
        contact = legs.contact(joints[leg], joints[leg + 1])
        if not contact:
            continue
        found = legs.detour(joints[leg], joints[leg + 1])
        if found is None:
            refused.append((int(order[leg]), f"no free way to the next station: {contact}"))
        else:
            vias[leg] = found
            notes.append(f"leg {leg + 1} goes over {len(found)} via point(s): on the straight line {contact}")
    return vias, tuple(notes), tuple(refused)


def shorter_order(legs: Legs, joints: Floats, vias: dict[int, Floats], law: Floats, timed: bool) -> Ints:
    """Return the order (n,) of joints (n, r) with the shortest tour, those via points included; as it is if none is.

    Legs count as free until they are on the shortest tour, where they are tested: what is the shortest of tested legs
    is the shortest of all, but for other via points than the given ones.
    """
    count = len(joints)
    cost = np.array([[leg_lengths(joints[[i, j]], {}, law, timed)[0] for j in range(count)] for i in range(count)])
    lengths, tested = leg_lengths(joints, vias, law, timed), set()
    for leg in range(count - 1):
        cost[leg, leg + 1] = cost[leg + 1, leg] = lengths[leg]
        tested.add((leg, leg + 1))
    for _ in range(_ROUNDS):
        order, length = open_path(cost)
        if length >= lengths.sum() * (1.0 - 1e-9):
            break
        pairs = {(min(pair), max(pair)) for pair in itertools.pairwise(order.tolist())} - tested
        if not pairs:
            return order
        for i, j in sorted(pairs):
            if legs.contact(joints[i], joints[j]):
                cost[i, j] = cost[j, i] = _BARRED
        tested |= pairs
    return np.arange(count)
