"""Joint tours: exact for a fixed order, near the optimum together, quick enough for the search."""

import itertools
import time

import numpy as np
import pytest

from netdesign.model.compiled import entry
from netdesign.model.frames import sphere_directions
from netdesign.motion.exact_tour import exact_joint_tour
from netdesign.motion.joint_tour import (
    MOST_JOINTS,
    NO_TURN,
    choose_options,
    directions_tour,
    joint_tour,
    law_of,
    network_tour,
    search_work_for,
    work_for,
)
from netdesign.motion.timing import leg_time
from tests.cells import joint_map, reachable_viewpoints

NO_LABEL, NOTHING = np.empty((0, 0), dtype=np.int64), np.empty((0, 0, 0, 0))

TOUR = entry()(network_tour)


def tour_of(of_map, timed, dwell, drawn):
    return TOUR(of_map.arrays, law_of(of_map.arm), timed, dwell, drawn, *search_work_for(of_map.arrays, len(drawn)))


def instance(n, seed, most=4):
    """Options of n stations, in whole vectors of four, of which up to ``most`` count."""
    rng = np.random.default_rng(seed)
    options = rng.uniform(-np.pi, np.pi, (n, 6, 4))
    return options, rng.integers(1, most + 1, n)


def leg(a, b, law, timed):
    d = np.abs(a - b)
    d = np.where(law[3, :6] < NO_TURN, np.minimum(d, 2 * np.pi - d), d)
    if timed:
        return leg_time(np.zeros(6), d, 1 / law[1, :6], 1 / law[2, :6])
    return np.linalg.norm(law[0, :6] * d)


def some_law():
    law = np.zeros((4, MOST_JOINTS))
    law[0, :6] = [1, 2, 1, 0.5, 1, 1]
    law[1, :6], law[2, :6] = 1 / 1.05, 1 / 1.4
    law[3] = 2 * np.pi
    law[3, 2] = NO_TURN
    return law


@pytest.mark.parametrize("timed", [False, True])
def test_options_of_a_fixed_order_are_the_best_there_are(timed):
    law = some_law()
    for seed in range(5):
        options, count = instance(4, seed)
        tour = np.array([0, 3, 1, 4, 2])
        choice = np.zeros(4, dtype=np.int64)
        length = choose_options(options, count, NO_LABEL, NOTHING, tour, law, timed, choice, work_for(4, 6, 4))
        order = tour[1:] - 1
        best = min(
            sum(leg(options[i, :, pick[i]], options[j, :, pick[j]], law, timed) for i, j in itertools.pairwise(order))
            for pick in itertools.product(*[range(c) for c in count])
        )
        assert length == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize("timed", [False, True])
def test_exact_tour_equals_brute_force_and_the_alternation_is_never_shorter(timed):
    law = some_law()
    for seed in range(4):
        options, count = instance(4, seed, most=3)
        tour, choice, length = exact_joint_tour(options, count, NO_LABEL, NOTHING, law, timed)
        best = min(
            sum(leg(options[i, :, pick[i]], options[j, :, pick[j]], law, timed) for i, j in itertools.pairwise(order))
            for order in itertools.permutations(range(4))
            for pick in itertools.product(*[range(c) for c in count])
        )
        assert length == pytest.approx(best, rel=1e-12)
        order = tour[1:] - 1
        driven = sum(
            leg(options[i, :, choice[i]], options[j, :, choice[j]], law, timed) for i, j in itertools.pairwise(order)
        )
        assert driven == pytest.approx(length, rel=1e-12)
        found = joint_tour(options, count, NO_LABEL, NOTHING, law, timed, np.arange(5), 3, work_for(4, 6, 4))
        assert found >= length * (1 - 1e-12)


def test_barred_legs_are_avoided():
    law = some_law()
    options, count = instance(5, 1)
    count[:] = 4
    label = np.tile(np.arange(4), (5, 1))
    tour, choice, _ = exact_joint_tour(options, count, label, NOTHING, law, False)
    i, j = tour[1] - 1, tour[2] - 1
    barred = np.zeros((5, 5, 4, 4))
    barred[i, j, choice[i], choice[j]] = barred[j, i, choice[j], choice[i]] = 1e3
    again, other, length = exact_joint_tour(options, count, label, barred, law, False)
    assert length < 1e3
    order = again[1:] - 1
    for a, b in itertools.pairwise(order):
        assert barred[a, b, other[a], other[b]] == 0.0
    found = joint_tour(options, count, label, barred, law, False, again.copy(), 3, work_for(5, 6, 4))
    assert found == pytest.approx(length, rel=1e-9)


def test_search_tours_against_the_exact_optimum():
    """n = 8 stations of the default cell, all branches: the search's own kernel, from one start."""
    of_map = joint_map()
    law = law_of(of_map.arm)
    ratios = []
    for seed in range(30):
        drawn = reachable_viewpoints(of_map, 8, seed)
        options, count = of_map.options(drawn)
        *_, best = exact_joint_tour(options, count, NO_LABEL, NOTHING, law, False)
        found, refused = tour_of(of_map, False, 0.0, drawn)
        assert refused == 0
        ratios.append(found / best)
    assert min(ratios) > 1 - 1e-12
    assert np.mean(ratios) < 1.08


def test_unreachable_stations_are_counted_and_left_out():
    of_map = joint_map("coaxial")
    drawn = reachable_viewpoints(of_map, 5, 1)
    blind = np.array([[0.0, -1.2]])
    length, refused = tour_of(of_map, False, 0.0, drawn)
    longer, missing = tour_of(of_map, False, 0.0, np.concatenate([drawn, blind]))
    assert (refused, missing) == (0, 1)
    assert longer == pytest.approx(length, rel=1e-12)
    timed, _ = tour_of(of_map, True, 0.5, drawn)
    assert timed > 0.5 * 5


def test_start_order_visits_every_station_once():
    drawn = reachable_viewpoints(joint_map(), 9, 4)
    assert sorted(directions_tour(sphere_directions(drawn)).tolist()) == list(range(10))


@pytest.mark.slow
def test_viewpoints_per_second_of_the_joint_objective():
    """n = 10, one core: the reference machine of the notes gave 190 to 260 thousand per second."""
    of_map = joint_map()
    networks = [reachable_viewpoints(of_map, 10, seed) for seed in range(40)]
    tour_of(of_map, False, 0.0, networks[0])
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        for network in networks * 10:
            tour_of(of_map, False, 0.0, network)
        best = min(best, time.process_time() - start)
    assert 400 * 10 / best > 1e5
