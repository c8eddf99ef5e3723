"""Structured chromosomes and their objectives, as plain arrays.

A chromosome has n slots; a bit says whether a slot is decoded, its genes (d numbers) say what it decodes to. Objectives
are minimised; a violation of 0 means feasible, larger is worse, and the objectives of an infeasible row mean nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Population:
    """P chromosomes with their objectives.

    Attributes:
        bits: (P, n).  genes: (P, n, d).  objectives: (P, q).  violation: (P,).
    """

    bits: Bools
    genes: Floats
    objectives: Floats
    violation: Floats

    def __len__(self) -> int:
        return len(self.bits)

    def take(self, rows: Ints | Bools) -> "Population":
        """Return the chosen rows."""
        return Population(
            bits=self.bits[rows],
            genes=self.genes[rows],
            objectives=self.objectives[rows],
            violation=self.violation[rows],
        )

    @property
    def feasible(self) -> "Population":
        """The rows without violation."""
        return self.take(self.violation <= 0)


def joined(parts: list[Population]) -> Population:
    """Return the populations one after the other."""
    return Population(
        bits=np.concatenate([part.bits for part in parts]),
        genes=np.concatenate([part.genes for part in parts]),
        objectives=np.concatenate([part.objectives for part in parts]),
        violation=np.concatenate([part.violation for part in parts]),
    )


Evaluate = Callable[[Bools, Floats], tuple[Floats, Floats]]
"""(bits (P, n), genes (P, n, d)) to (objectives (P, q), violation (P,)): a row's result depends on that row only."""

Vary = Callable[[np.random.Generator, Population, Population], tuple[Bools, Floats]]
"""(random numbers, first parents, second parents, pair by pair) to the children's (bits, genes), two per pair."""


class SearchProblem(Protocol):
    """What an engine asks of a problem."""

    def evaluate(self, bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        """Return (objectives (P, q), violation (P,)); the last objective is a whole number, the size."""

    def random(self, rng: np.random.Generator, count: int) -> tuple[Bools, Floats]:
        """Return ``count`` random chromosomes."""

    def seeds(self) -> tuple[Bools, Floats]:
        """Return chromosomes worth starting from; may be empty."""

    def vary_plain(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return children by the source paper's operators."""

    def vary_structured(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return children by operators that know what a gene means."""

    def improve(self, rng: np.random.Generator, members: Population, preference: Floats) -> Population:
        """Return evaluated neighbours of feasible members: every row counts as one evaluation.

        preference: (P,) in [0, 1], how much the first objective counts against the second.
        """

    def normalise(self, objectives: Floats) -> Floats:
        """Return objectives (P, q) on scales where 0 is ideal and 1 the reference point of the hypervolume."""


def evaluated(evaluate: Evaluate, bits: Bools, genes: Floats) -> Population:
    """Return the chromosomes with their objectives.

    Raises:
        InputError: the shapes do not fit.
    """
    if bits.shape != genes.shape[:2]:
        raise InputError(f"chromosomes: expected bits {genes.shape[:2]}, found {bits.shape}")
    objectives, violation = evaluate(bits, genes)
    return Population(bits=bits, genes=genes, objectives=objectives, violation=violation)
