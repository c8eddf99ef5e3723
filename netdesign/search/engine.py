"""The engines: NSGA-II as in the source paper, and the memetic search that is the default.

Both count their budget in evaluations, population x generations (what the seeds take before the first generation, f1 of
some thousand networks of a few stations for each size, is not in it), and draw every random number from one generator
outside the evaluation: a seed gives one result, whatever the number of threads and however often it was stopped.

* ``nsga2``: tournaments, uniform and SBX crossover, bit-flip and polynomial mutation, elitist survival, no copies.
* ``memetic``: starts from seeds (set cover), spends a fifth of the generations (at most 60) on NSGA-II with operators
  that know what a gene means, then improves members of the archive one gene at a time until the budget is used; every
  fourth time neighbours on the front are crossed instead, which brings together what was improved apart.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import moocore
import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError
from netdesign.search.archive import empty_archive
from netdesign.search.population import Bools, Floats, Ints, Population, SearchProblem, Vary, evaluated, joined
from netdesign.search.selection import ranked, survive, tournament
from netdesign.search.state import State, generator_state, restored_generator

Engine = Literal["memetic", "nsga2"]

GENETIC_SHARE, GENETIC_MOST = 0.2, 60
BREEDINGS = 20  # rounds of breeding that may replace copies
SPARE = 4  # per cent of pairs that breed beyond need, in place of copies: cheaper than another round
STRIDE = 10  # generations of breeding between two updates of the archive
FEWEST_PICKS, MOST_PICKS = 8, 32  # members improved between two updates of the archive, a sixth of the population
SPREAD = 0.2  # of the preferences about the place on the staircase
MEMBERS_PER_PICK = 50  # more of them once the archive is long, for its update takes as long as it is
CROSSED_EVERY, PAIRS = 4, 4  # steps of the local search, and pairs of parents then, for each of the population
NEARBY = 0.2  # how far along the staircase, as a share of it, the other parent may be

OnStep = Callable[[State], None]


def run(
    problem: SearchProblem, engine: Engine, population: int, generations: int, seed: int,
    resume: State | None = None, on_step: OnStep | None = None,
) -> State:  # fmt: skip
    """Search until population x generations networks have been evaluated; return the last state.

    Args:
        problem: what is searched.  engine: which of the two.
        population: chromosomes per generation.  generations: with it, the budget.
        seed: of all random numbers.
        resume: the state to go on from; it must come from a search with the same arguments.
        on_step: called with the state after every step; it may save it, and raising stops the search.
    """
    if population < 4 or population % 2:
        population += population % 2 + max(0, 4 - population)
    state = resume or start(problem, engine, population, seed)
    if resume is None and on_step:
        on_step(state)
    for following in steps(problem, engine, state, population, generations):
        state = following
        if on_step:
            on_step(state)
    return state


def start(problem: SearchProblem, engine: Engine, population: int, seed: int) -> State:
    """Return the state after the first generation: random chromosomes, and seeds if the engine wants them."""
    rng = np.random.Generator(np.random.PCG64(seed))
    bits, genes = problem.random(rng, population)
    if engine == "memetic":
        seed_bits, seed_genes = problem.seeds()
        count = min(len(seed_bits), population // 2)
        bits = np.concatenate([seed_bits[:count], bits[count:]])
        genes = np.concatenate([seed_genes[:count], genes[count:]])
    elif engine != "nsga2":
        raise InputError(f"engine: expected memetic or nsga2, found {engine}")
    first = evaluated(problem.evaluate, bits, genes)
    archive = empty_archive(bits.shape[1], genes.shape[2], first.objectives.shape[1])
    ranks, crowding = ranked(first)
    empty = State(
        step=0, population=first, ranks=ranks, crowding=crowding, archive=archive, evaluations=np.zeros(0, np.int64),
        hypervolume=np.zeros(0), random=generator_state(rng), pending=(first,),
    )  # fmt: skip
    return _noted(problem, empty)


def steps(problem: SearchProblem, engine: Engine, state: State, population: int, generations: int) -> Iterator[State]:
    """Yield the states after every further step until the budget is used."""
    rng = restored_generator(state.random)
    budget = population * generations
    genetic = generations if engine == "nsga2" else min(GENETIC_MOST, max(1, round(GENETIC_SHARE * generations)))
    vary = problem.vary_plain if engine == "nsga2" else problem.vary_structured
    while state.spent < budget:
        # Without a feasible network there is nothing to improve: go on breeding.
        if state.step < genetic or len(state.archive) == 0:
            children = offspring(rng, problem, state.population, state.ranks, state.crowding, vary)
            survivors, ranks, crowding = survive(joined([state.population, children]), population)
            state = replace(state, population=survivors, ranks=ranks, crowding=crowding)
        elif state.step % CROSSED_EVERY == 0:
            children = evaluated(problem.evaluate, *_crossed(rng, problem, state, PAIRS * population))
        else:
            children = problem.improve(rng, *_picks(rng, state, population))
        pending = (*state.pending, children)
        state = replace(state, step=state.step + 1, random=generator_state(rng), pending=pending)
        # Breeding does not look at the archive: it may wait.
        if state.step % STRIDE == 0 or state.step >= genetic or state.spent >= budget:
            state = _noted(problem, state)
        yield state


def offspring(
    rng: np.random.Generator, problem: SearchProblem, population: Population, ranks: Ints, crowding: Floats, vary: Vary
) -> Population:
    """Return as many evaluated children as there are parents, which win tournaments by rank and crowding (P,).

    A child that is a copy of a member or of another child would cost an evaluation and crowd out a network that
    differs: other parents breed in its place.
    """
    count = len(population)
    known = _fingerprints(population.bits, population.genes)
    bits, genes = population.bits[:0], population.genes[:0]
    for attempt in range(BREEDINGS):
        pairs = (count - len(bits) + 1) // 2
        pairs += SPARE * pairs // 100 + 1
        parents = tournament(rng, ranks, crowding, 2 * pairs)
        new_bits, new_genes = vary(rng, population.take(parents[0::2]), population.take(parents[1::2]))
        if attempt < BREEDINGS - 1:  # a space of few chromosomes may have no others
            both = np.concatenate([known, _fingerprints(new_bits, new_genes)])
            first = np.unique(both, return_index=True)[1]
            fresh = np.sort(first[first >= len(known)]) - len(known)
            new_bits, new_genes, known = new_bits[fresh], new_genes[fresh], both
        bits, genes = np.concatenate([bits, new_bits])[:count], np.concatenate([genes, new_genes])[:count]
        if len(bits) == count:
            break
    return evaluated(problem.evaluate, bits, genes)


def _fingerprints(bits: Bools, genes: Floats) -> NDArray[np.uint64]:
    """A hash (P,) of 64 bits per chromosome: equal for equal ones, and by chance never for others."""
    words = np.ascontiguousarray(genes).reshape(len(genes), -1).view(np.uint64)
    words = words ^ (words >> np.uint64(32))  # what differs in the high bits only would be multiplied out of the word
    slots = bits.shape[1]
    factors = _factors(words.shape[1] + slots)
    hashed = np.einsum("pv,v->p", words, factors[slots:])
    return np.asarray(hashed + np.einsum("pn,n->p", bits.astype(np.uint64), factors[:slots]))


@lru_cache
def _factors(count: int) -> NDArray[np.uint64]:
    return np.random.default_rng(0).integers(0, 1 << 63, count, dtype=np.uint64) * 2 + 1


def _picks(rng: np.random.Generator, state: State, population: int) -> tuple[Population, Floats]:
    """Members for the local search, and what each is improved for: a size at random, so that none is neglected.

    Of a size one of its staircase: where that falls steeply, at the small first objectives, the first counts most.
    """
    count = max(min(MOST_PICKS, max(FEWEST_PICKS, population // 6)), len(state.archive) // MEMBERS_PER_PICK)
    layer, place = _places(rng, state, count)
    rows = _rows(state, layer, place)
    preference = np.clip(1.0 - place + SPREAD * rng.uniform(-1.0, 1.0, count), 0.0, 1.0)
    return state.archive.members.take(rows), preference


def _crossed(rng: np.random.Generator, problem: SearchProblem, state: State, pairs: int) -> tuple[Bools, Floats]:
    """Chromosomes of the children of neighbours on the front, of as many images or those of one size more or less."""
    layer, place = _places(rng, state, pairs)
    other = np.clip(layer + rng.integers(-1, 2, pairs), 0, len(np.unique(state.archive.sizes)) - 1)
    near = np.clip(place + NEARBY * rng.uniform(-1.0, 1.0, pairs), 0.0, np.nextafter(1.0, 0.0))
    members = state.archive.members
    first, second = members.take(_rows(state, layer, place)), members.take(_rows(state, other, near))
    return problem.vary_structured(rng, first, second)


def _places(rng: np.random.Generator, state: State, count: int) -> tuple[Ints, Floats]:
    """Sizes of the archive at random, so that none is neglected, and places in [0, 1) along their staircases."""
    layer: Ints = rng.integers(0, len(np.unique(state.archive.sizes)), count)
    return layer, rng.random(count)


def _rows(state: State, layer: Ints, place: Floats) -> Ints:
    """Rows (k,) of the archive by layer, counted among its sizes, and place in [0, 1) along that layer's staircase."""
    _, starts, counts = np.unique(state.archive.sizes, return_index=True, return_counts=True)
    return np.asarray(starts[layer] + np.floor(place * counts[layer]).astype(np.int64))


def _noted(problem: SearchProblem, state: State) -> State:
    """The state with what was pending in the archive and one more line of history."""
    archive = state.archive.with_rows(joined([population.feasible for population in state.pending]))
    return replace(
        state,
        archive=archive,
        evaluations=np.append(state.evaluations, state.spent),
        hypervolume=np.append(state.hypervolume, hypervolume(problem, archive.members.objectives)),
        pending=(),
    )


def hypervolume(problem: SearchProblem, objectives: Floats) -> float:
    """Return the hypervolume of feasible objectives (N, q), normalised to [0, 1] by the problem's scales."""
    scaled = np.maximum(problem.normalise(objectives), 0.0) if len(objectives) else objectives
    scaled = scaled[(scaled < 1.0).all(axis=1)]
    return float(moocore.hypervolume(scaled, ref=1.0)) if len(scaled) else 0.0
