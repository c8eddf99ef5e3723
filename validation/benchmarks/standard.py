"""NSGA-II on ZDT and DTLZ: final hypervolume against the closed forms and against pymoo at equal evaluations."""

from collections.abc import Iterator

import moocore
import numpy as np
from pymoo.algorithms.moo.nsga2 import NSGA2
from pymoo.optimize import minimize
from pymoo.problems import get_problem

from netdesign.search.engine import offspring
from netdesign.search.operators import polynomial_mutation, sbx
from netdesign.search.population import Population, evaluated, joined
from netdesign.search.selection import ranked, survive
from validation.benchmarks.table import Row

# Of the true fronts at reference point 1.1 (reference cases, section 6).
CLOSED_FORMS = {
    "zdt1": 0.8766667, "zdt2": 0.5433333, "zdt3": 1.3317629, "zdt4": 0.8766667, "zdt6": 0.5078775,
    "dtlz1": 1.3101667, "dtlz2": 0.8074012,
}  # fmt: skip
POPULATION, GENERATIONS = 100, 250


class Real:
    """A test problem with one slot per variable, all bits set."""

    def __init__(self, name: str) -> None:
        self.inner = get_problem(name)

    def evaluate(self, bits, genes):
        """Return the objectives; nothing is infeasible."""
        return self.inner.evaluate(genes[..., 0]), np.zeros(len(genes))

    def vary_plain(self, rng, first, second):
        """Return children by SBX and polynomial mutation."""
        lower, upper = self.inner.xl, self.inner.xu
        children = sbx(rng, first.genes[..., 0], second.genes[..., 0], lower, upper, 0.9, 15)
        children = polynomial_mutation(rng, children, lower, upper, 1 / len(lower), 20)
        return np.ones(children.shape, bool), children[..., None]


def ours(name: str, seed: int) -> np.ndarray:
    """Return the objectives of the last population."""
    problem, rng = Real(name), np.random.default_rng(seed)
    genes = rng.uniform(problem.inner.xl, problem.inner.xu, (POPULATION, problem.inner.n_var))[..., None]
    population: Population = evaluated(problem.evaluate, np.ones(genes.shape[:2], bool), genes)
    ranks, crowding = ranked(population)
    for _ in range(GENERATIONS - 1):
        children = offspring(rng, problem, population, ranks, crowding, problem.vary_plain)
        population, ranks, crowding = survive(joined([population, children]), POPULATION)
    return population.objectives


def theirs(name: str, seed: int) -> np.ndarray:
    """Return the same of pymoo's NSGA-II with its own settings."""
    result = minimize(get_problem(name), NSGA2(pop_size=POPULATION), ("n_gen", GENERATIONS), seed=seed)
    return np.atleast_2d(result.F)


def rows(seeds: int) -> Iterator[Row]:
    """Yield per problem where our runs lie in pymoo's range, 0 its lowest hypervolume, 1 its highest; medians said."""
    for name, exact in CLOSED_FORMS.items():
        mine, others = (
            np.array([moocore.hypervolume(side(name, seed), ref=1.1) for seed in range(1, seeds + 1)])
            for side in (ours, theirs)
        )
        if max(mine.max(), others.max()) > exact + 1e-7:
            raise RuntimeError(f"{name}: a hypervolume above the closed form {exact}")
        low, high = others.min(), others.max()
        place = (mine - low) / (high - low)
        yield Row(
            f"NSGA-II on {name.upper()}, {seeds} seeds: hypervolume in pymoo's range",
            0.0,
            place.tolist(),
            f"ours {np.median(mine):.4f} ({mine.min():.4f} to {mine.max():.4f});"
            f" pymoo {np.median(others):.4f} ({low:.4f} to {high:.4f}); closed form {exact:.4f}",
        )
