"""Laws of open paths: permutations, optimal where exact, never longer than brute force allows."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netdesign.errors import InputError
from netdesign.motion.tour import held_karp, nearest_neighbour_3opt, open_path, path_length


def stations(count, seed):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    return 0.6 * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def distances(positions):
    return np.linalg.norm(positions[:, None] - positions[None], axis=2)


def walk(distance, order):
    return float(distance[order[:-1], order[1:]].sum())


@given(st.integers(1, 40), st.integers(0, 10**6))
@settings(deadline=None, max_examples=60)
def test_paths_are_permutations_of_the_claimed_length(count, seed):
    positions = stations(count, seed)
    distance = distances(positions)
    for order, length in (nearest_neighbour_3opt(distance), open_path(distance)):
        assert sorted(order) == list(range(count))
        assert length == pytest.approx(walk(distance, order), rel=1e-12, abs=1e-15)
    assert path_length(positions) == pytest.approx(nearest_neighbour_3opt(distance)[1], rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7])
def test_exact_paths_equal_brute_force(count):
    distance = distances(stations(count, count))
    best = min(walk(distance, np.array(order)) for order in permutations(range(count)))
    order, length = held_karp(distance)
    assert length == pytest.approx(best, rel=1e-12, abs=1e-15)
    assert walk(distance, order) == pytest.approx(best, rel=1e-12, abs=1e-15)


def is_3_optimal(distance, order):
    """Brute force over all triples of legs of the closed tour with a dummy, every reconnection."""
    n = len(order)
    padded = np.zeros((n + 1, n + 1))
    padded[1:, 1:] = distance
    tour = [0, *(order + 1)]
    length = walk(distance, order)
    for i in range(n + 1):
        for j in range(i + 1, n + 1):
            for k in range(j + 1, n + 1):
                head, a, b, tail = tour[: i + 1], tour[i + 1 : j + 1], tour[j + 1 : k + 1], tour[k + 1 :]
                for first, second in ((a, b), (b, a)):
                    for one in (first, first[::-1]):
                        for two in (second, second[::-1]):
                            new = np.array([*head, *one, *two, *tail, 0])
                            if padded[new[:-1], new[1:]].sum() < length * (1 - 1e-9):
                                return False
    return True


@pytest.mark.parametrize("count", [4, 5, 8, 11])
def test_the_heuristic_ends_3_optimal(count):
    for seed in range(5):
        distance = distances(stations(count, seed))
        order, _ = nearest_neighbour_3opt(distance)
        assert is_3_optimal(distance, order)


def test_the_heuristic_is_near_the_optimum_and_the_search_beyond_twelve_never_above_it():
    gaps = []
    for seed in range(20):
        distance = distances(stations(12, seed))
        gaps.append(nearest_neighbour_3opt(distance)[1] / held_karp(distance)[1] - 1)
        distance = distances(stations(13, seed))
        assert open_path(distance)[1] == pytest.approx(held_karp(distance)[1], rel=1e-9)
        longer = distances(stations(25, seed))
        assert open_path(longer)[1] <= nearest_neighbour_3opt(longer)[1] * (1 + 1e-12)
    assert min(gaps) > -1e-12
    assert np.mean(gaps) < 0.02


def test_coincident_stations_cost_nothing():
    positions = np.repeat(stations(4, 1), 3, axis=0)
    assert open_path(distances(positions))[1] == pytest.approx(open_path(distances(stations(4, 1)))[1], abs=1e-12)


def test_bad_distances_are_refused():
    with pytest.raises(InputError, match="symmetric"):
        open_path(np.array([[0.0, 1.0], [2.0, 0.0]]))
    with pytest.raises(InputError, match="square"):
        open_path(np.zeros((2, 3)))
