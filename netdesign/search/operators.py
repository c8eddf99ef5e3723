"""Genetic operators of the source paper on arrays: uniform crossover, bit flips, SBX, polynomial mutation.

Sources: K. Deb, R. B. Agrawal, Complex Systems 9, 1995 (SBX); K. Deb, M. Goyal, Computer Science and Informatics 26(4),
1996 (polynomial mutation). Both with the boundary-aware spread factor of Deb's NSGA-II.
"""

import math

import numpy as np

from netdesign.search.population import Bools, Floats


def coins(rng: np.random.Generator, shape: tuple[int, ...]) -> Bools:
    """Return fair coins (*shape), one random bit each."""
    count = math.prod(shape)
    drawn = np.frombuffer(rng.bytes(-(-count // 8)), np.uint8)
    return np.unpackbits(drawn, count=count).view(np.bool_).reshape(shape)


def chances(rng: np.random.Generator, shape: tuple[int, ...], probability: float) -> Bools:
    """Return (*shape), true with ``probability``, which is rounded to 24 bits: half the time of doubles."""
    return np.asarray(rng.random(shape, dtype=np.float32) < np.float32(probability))


def uniform_crossover(rng: np.random.Generator, first: Bools, second: Bools, probability: float) -> Bools:
    """Return children bits (2P, n) of parents (P, n): a crossed pair swaps each bit with probability one half."""
    swap = chances(rng, (len(first), 1), probability) & coins(rng, first.shape)
    swap &= first ^ second
    return np.concatenate([first ^ swap, second ^ swap])


def flip_bits(rng: np.random.Generator, bits: Bools, probability: float) -> Bools:
    """Return bits (P, n), each flipped with ``probability``."""
    return bits ^ chances(rng, bits.shape, probability)


def sbx(
    rng: np.random.Generator, first: Floats, second: Floats, lower: Floats, upper: Floats,
    probability: float, eta: float,
) -> Floats:  # fmt: skip
    """Return children (2P, v) of real parents (P, v) within bounds (v,) by simulated binary crossover.

    A crossed pair (``probability``) crosses each variable with probability one half; a large ``eta`` keeps children
    near their parents.
    """
    crossed = chances(rng, (len(first), 1), probability) & coins(rng, first.shape)
    crossed &= np.abs(second - first) > 1e-14
    where = np.flatnonzero(crossed)  # powers are dear: only where they are needed
    mother, father = first.ravel()[where], second.ravel()[where]
    low, high, variable = np.minimum(mother, father), np.maximum(mother, father), where % first.shape[1]
    lower, upper, distance = lower[variable], upper[variable], high - low
    # The spread factors towards the lower and the upper bound, from the same draw.
    room, draw = np.stack([low - lower, upper - high]), rng.random(len(where))
    alpha = 2.0 - raised(distance / (distance + 2.0 * room), eta + 1.0)
    scaled = draw * alpha
    spread = root(np.where(scaled <= 1.0, scaled, 1.0 / np.maximum(2.0 - scaled, 1e-300)), eta + 1.0) * distance
    total = low + high
    one = np.minimum(np.maximum(0.5 * (total - spread[0]), lower), upper)
    two = np.minimum(np.maximum(0.5 * (total + spread[1]), lower), upper)
    swap = coins(rng, where.shape)
    children = np.concatenate([first, second])
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
    where = np.flatnonzero(chances(rng, values.shape, probability))
    variable, old, draw = where % values.shape[1], values.ravel()[where], rng.random(len(where))
    lower, upper = lower[variable], upper[variable]
    width = upper - lower
    below, above = (old - lower) / width, (upper - old) / width
    power = 1.0 / (eta + 1.0)
    down = (2.0 * draw + (1.0 - 2.0 * draw) * (1.0 - below) ** (eta + 1.0)) ** power - 1.0
    up = 1.0 - (2.0 * (1.0 - draw) + 2.0 * (draw - 0.5) * (1.0 - above) ** (eta + 1.0)) ** power
    changed = np.array(values)
    changed.reshape(-1)[where] = np.clip(old + np.where(draw < 0.5, down, up) * width, lower, upper)
    return changed
