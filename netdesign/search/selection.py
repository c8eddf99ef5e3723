"""NSGA-II's selection: constrained non-dominated sorting, crowding, elitist survival, tournaments.

Source: K. Deb, S. Agrawal, A. Pratap, T. Meyarivan, PPSN VI, 2000, with constrained domination of IEEE TEVC 6(2), 2002:
feasible before infeasible, feasible by domination, infeasible by violation.
"""

from typing import Any

import moocore
import numpy as np
from numpy.typing import NDArray

from netdesign.search.population import Bools, Floats, Ints, Population


def constrained_ranks(objectives: Floats, violation: Floats) -> Ints:
    """Return the front (P,) of every row, 0 the best; equal violations share a front behind all feasible ones."""
    ranks = np.zeros(len(objectives), dtype=np.int64)
    feasible = violation <= 0
    fronts = 0
    if feasible.any():
        ranks[feasible] = moocore.pareto_rank(objectives[feasible])
        fronts = int(ranks[feasible].max()) + 1
    if not feasible.all():
        ranks[~feasible] = fronts + np.unique(violation[~feasible], return_inverse=True)[1]
    return ranks


def first_of_runs(sorted_values: NDArray[Any]) -> tuple[Bools, Bools]:
    """Return where runs of equal values begin and where they end, (N,) each."""
    starts, ends = np.ones(len(sorted_values), np.bool_), np.ones(len(sorted_values), np.bool_)
    np.not_equal(sorted_values[1:], sorted_values[:-1], out=starts[1:])
    ends[:-1] = starts[1:]
    return starts, ends


def crowding(objectives: Floats, ranks: Ints) -> Floats:
    """Return the crowding distance (P,) of every row within its front; inf at the ends of each objective."""
    count, criteria = objectives.shape
    if count == 0:
        return np.zeros(0)
    rows, values = np.arange(criteria)[:, None], objectives.T
    order = np.argsort(values, axis=1, kind="stable")
    short = ranks.astype(np.uint16) if count < 1 << 16 else ranks  # sorted by radix
    order = order[rows, np.argsort(short[order], axis=1, kind="stable")]
    ordered = values[rows, order]
    starts, ends = first_of_runs(ranks[order[0]])  # the fronts lie alike for every objective
    extent = (ordered[:, ends] - ordered[:, starts])[:, np.cumsum(starts) - 1]
    step = np.zeros((criteria, count))
    np.divide(ordered[:, 2:] - ordered[:, :-2], extent[:, 1:-1], out=step[:, 1:-1], where=extent[:, 1:-1] > 0)
    step[:, starts | ends] = np.inf
    distance = np.empty((criteria, count))
    distance[rows, order] = step
    return np.asarray(distance.sum(axis=0))


def ranked(population: Population) -> tuple[Ints, Floats]:
    """Return front and crowding distance (P,) of every row."""
    ranks = constrained_ranks(population.objectives, population.violation)
    # Infeasible rows are ordered by violation alone: their objectives mean nothing.
    readable = np.where((population.violation <= 0)[:, None], population.objectives, 0.0)
    return ranks, crowding(readable, ranks)


def survive(population: Population, size: int) -> tuple[Population, Ints, Floats]:
    """Return the best ``size`` rows by front, then crowding, with their ranks and crowding distances."""
    ranks, distance = ranked(population)
    chosen = np.lexsort((-distance, ranks))[:size]
    return population.take(chosen), ranks[chosen], distance[chosen]


def tournament(rng: np.random.Generator, ranks: Ints, distance: Floats, count: int) -> Ints:
    """Return ``count`` winners of binary tournaments: lower front, then larger crowding distance, then chance.

    The pairs are read off random permutations, as in Deb's program: everybody competes equally often. Pairs drawn
    independently leave a seventh of the population out of two rounds, which costs measurably on ZDT1 and ZDT2.
    """
    entrants = np.tile(np.arange(len(ranks)), (-(-2 * count // len(ranks)), 1))
    pairs = rng.permuted(entrants, axis=1).ravel()[: 2 * count].reshape(count, 2)
    coin = rng.random(count) < 0.5
    one, two = pairs[:, 0], pairs[:, 1]
    better = (ranks[one] < ranks[two]) | ((ranks[one] == ranks[two]) & (distance[one] > distance[two]))
    worse = (ranks[two] < ranks[one]) | ((ranks[one] == ranks[two]) & (distance[two] > distance[one]))
    return np.where(better | (~worse & coin), one, two)
