"""Genetic operators of the source paper on arrays: uniform crossover, bit flips, SBX, polynomial mutation.

Sources: K. Deb, R. B. Agrawal, Complex Systems 9, 1995 (SBX); K. Deb, M. Goyal, Computer Science and Informatics 26(4),
1996 (polynomial mutation). Both with the boundary-aware spread factor of Deb's NSGA-II.
"""

import numpy as np

from netdesign.search.population import Bools, Floats


def uniform_crossover(rng: np.random.Generator, first: Bools, second: Bools, probability: float) -> Bools:
    """Return children bits (2P, n) of parents (P, n): a crossed pair swaps each bit with probability one half."""
    swap = (rng.random((len(first), 1)) < probability) & (rng.random(first.shape) < 0.5)
    return np.concatenate([np.where(swap, second, first), np.where(swap, first, second)])


def flip_bits(rng: np.random.Generator, bits: Bools, probability: float) -> Bools:
    """Return bits (P, n), each flipped with ``probability``."""
    return bits ^ (rng.random(bits.shape) < probability)


def sbx(
    rng: np.random.Generator, first: Floats, second: Floats, lower: Floats, upper: Floats,
    probability: float, eta: float,
) -> Floats:  # fmt: skip
    """Return children (2P, v) of real parents (P, v) within bounds (v,) by simulated binary crossover.

    A crossed pair (``probability``) crosses each variable with probability one half; a large ``eta`` keeps children
    near their parents.
    """
    crossed = (rng.random((len(first), 1)) < probability) & (rng.random(first.shape) < 0.5)
    draw, swap = rng.random(first.shape), rng.random(first.shape) < 0.5
    crossed &= np.abs(second - first) > 1e-14
    children = np.concatenate([first, second])
    where = np.flatnonzero(crossed)  # powers are dear: only where they are needed
    mother, father, draw, swap = first.ravel()[where], second.ravel()[where], draw.ravel()[where], swap.ravel()[where]
    variable = where % first.shape[1]
    lower, upper = np.broadcast_to(lower, first.shape[1])[variable], np.broadcast_to(upper, first.shape[1])[variable]
    low, high = np.minimum(mother, father), np.maximum(mother, father)
    distance = high - low

    def spread(room: Floats) -> Floats:
        alpha = 2.0 - raised(distance / (distance + 2.0 * room), eta + 1.0)
        inside = draw <= 1.0 / alpha
        base = np.where(inside, draw * alpha, 1.0 / np.maximum(2.0 - draw * alpha, 1e-300))
        return root(base, eta + 1.0)

    one = np.clip(0.5 * (low + high - spread(low - lower) * distance), lower, upper)
    two = np.clip(0.5 * (low + high + spread(upper - high) * distance), lower, upper)
    flat = children.reshape(-1)
    flat[where], flat[where + first.size] = np.where(swap, two, one), np.where(swap, one, two)
    return children


def raised(values: Floats, exponent: float) -> Floats:
    """Return values ** exponent; of a power of two by squaring, which takes a tenth of the time."""
    if exponent < 1 or np.frexp(exponent)[0] != 0.5:
        return np.asarray(values**exponent)
    for _ in range(round(np.log2(exponent))):
        values = values * values
    return values


def root(values: Floats, exponent: float) -> Floats:
    """Return values ** (1 / exponent), likewise."""
    if exponent < 1 or np.frexp(exponent)[0] != 0.5:
        return np.asarray(values ** (1.0 / exponent))
    for _ in range(round(np.log2(exponent))):
        values = np.sqrt(values)
    return values


def polynomial_mutation(
    rng: np.random.Generator, values: Floats, lower: Floats, upper: Floats, probability: float, eta: float
) -> Floats:
    """Return values (P, v) within bounds (v,), each mutated with ``probability`` by the polynomial distribution."""
    mutated, draw = rng.random(values.shape) < probability, rng.random(values.shape)
    where = np.flatnonzero(mutated)
    variable, old, draw = where % values.shape[1], values.ravel()[where], draw.ravel()[where]
    lower, upper = np.broadcast_to(lower, values.shape[1])[variable], np.broadcast_to(upper, values.shape[1])[variable]
    width = upper - lower
    below, above = (old - lower) / width, (upper - old) / width
    power = 1.0 / (eta + 1.0)
    down = (2.0 * draw + (1.0 - 2.0 * draw) * (1.0 - below) ** (eta + 1.0)) ** power - 1.0
    up = 1.0 - (2.0 * (1.0 - draw) + 2.0 * (draw - 0.5) * (1.0 - above) ** (eta + 1.0)) ** power
    changed = np.array(values)
    changed.reshape(-1)[where] = np.clip(old + np.where(draw < 0.5, down, up) * width, lower, upper)
    return changed
