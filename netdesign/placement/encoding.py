"""The structured chromosome of a camera network, n bits and n viewpoints, and what breeds it.

A viewpoint is (alpha, beta), with the share t of its depth as a third number where stations have one.

``vary_plain`` is the source paper: uniform crossover and bit flips, SBX and polynomial mutation of the angles, slot by
slot. ``vary_structured`` knows that slots have no meaning and angles lie on a sphere: a random plane cuts both parents,
a child takes one's cameras on this side and the other's on that side; then cameras are nudged, moved, added or removed.
"""

from dataclasses import dataclass, replace

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import sphere_directions, viewpoints_of
from netdesign.model.stations import ViewingSphere
from netdesign.placement.set_cover import lattice
from netdesign.search.operators import flip_bits, polynomial_mutation, sbx, uniform_crossover
from netdesign.search.population import Population

CROSSOVER, SBX_ETA, MUTATION_ETA = 0.9, 15.0, 20.0
DRAWS = 50  # for a direction that meets the box of admissible stations
SMALLEST_STEP, LARGEST_STEP = 0.002, 0.5  # rad, of a nudged camera, log-uniform


@dataclass(frozen=True, kw_only=True)
class Chromosomes:
    """The space of chromosomes over a viewing sphere.

    Attributes:
        sphere: the admissible viewpoints.  slots: n.
    """

    sphere: ViewingSphere
    slots: int

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper (d,) of (alpha, beta) in rad, and t."""
        (low_a, high_a), (low_b, high_b) = self.sphere.azimuth, self.sphere.elevation
        return np.array([low_a, low_b, 0.0][: self.sphere.genes]), np.array([high_a, high_b, 1.0][: self.sphere.genes])

    def uniform(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Return viewpoints (*shape, d), uniform over the admissible area (and the depth of each direction)."""
        lower, upper = self.bounds
        alpha = rng.uniform(lower[0], upper[0], shape)
        beta = np.arcsin(rng.uniform(np.sin(lower[1]), np.sin(upper[1]), shape))
        if self.sphere.depth is None:
            return np.stack([alpha, beta], axis=-1)
        viewpoints = np.stack([alpha, beta, rng.uniform(0.0, 1.0, shape)], axis=-1)
        for _ in range(DRAWS):  # directions without a station are drawn anew
            missed = ~self.sphere.admissible(viewpoints)
            if not missed.any():
                break
            count = int(missed.sum())
            viewpoints[missed, 0] = rng.uniform(lower[0], upper[0], count)
            viewpoints[missed, 1] = np.arcsin(rng.uniform(np.sin(lower[1]), np.sin(upper[1]), count))
        return viewpoints

    def spread(self, count: int) -> Floats:
        """Return about ``count`` viewpoints (c, d), evenly spread over the admissible area (Fibonacci lattice).

        With a depth: a third of the directions, on the nearest, the middle and the farthest stations.
        """
        if self.sphere.depth is not None:
            shells = (0.0, 0.5, 1.0) if self.sphere.depth.has_width else (0.5,)
            plane = self.plane.spread(-(-count // len(shells)))
            plane = plane[self.sphere.admissible(plane)]
            return np.concatenate([np.column_stack([plane, np.full(len(plane), t)]) for t in shells])
        lower, upper = self.bounds
        share = (upper[0] - lower[0]) * (np.sin(upper[1]) - np.sin(lower[1])) / (4 * np.pi)
        viewpoints = lattice(int(np.ceil(count / share)))
        viewpoints[:, 0] = lower[0] + np.remainder(viewpoints[:, 0] - lower[0], 2 * np.pi)
        inside = (viewpoints[:, 0] <= upper[0]) & (viewpoints[:, 1] >= lower[1]) & (viewpoints[:, 1] <= upper[1])
        return np.asarray(viewpoints[inside])

    @property
    def plane(self) -> "Chromosomes":
        """The same without the depth."""
        return replace(self, sphere=replace(self.sphere, depth=None))

    def folded(self, viewpoints: Floats) -> Floats:
        """Return viewpoints (…, d) brought into the bounds: the azimuth wraps, what is still outside is clipped."""
        lower, upper = self.bounds
        middle = 0.5 * (lower[0] + upper[0])
        alpha = middle + np.remainder(viewpoints[..., 0] - middle + np.pi, 2 * np.pi) - np.pi
        return np.asarray(np.clip(np.concatenate([alpha[..., None], viewpoints[..., 1:]], axis=-1), lower, upper))

    def random(self, rng: np.random.Generator, count: int) -> tuple[Bools, Floats]:
        """Return ``count`` chromosomes: sizes spread evenly from 2 to n, viewpoints uniform over the area."""
        sizes = rng.integers(min(2, self.slots), self.slots + 1, count)
        bits = np.argsort(rng.random((count, self.slots)), axis=1) < sizes[:, None]
        return bits, self.uniform(rng, (count, self.slots))

    def vary_plain(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return two children per pair of parents by the source paper's operators."""
        lower, upper = (np.tile(bound, self.slots) for bound in self.bounds)
        bits = uniform_crossover(rng, first.bits, second.bits, CROSSOVER)
        bits = flip_bits(rng, bits, 1.0 / self.slots)
        flat = (len(first), self.sphere.genes * self.slots)
        genes = sbx(rng, first.genes.reshape(flat), second.genes.reshape(flat), lower, upper, CROSSOVER, SBX_ETA)
        genes = polynomial_mutation(rng, genes, lower, upper, 1.0 / (self.sphere.genes * self.slots), MUTATION_ETA)
        return bits, genes.reshape(len(bits), self.slots, self.sphere.genes)

    def vary_structured(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        """Return two children per pair of parents: cut and splice, then one structural mutation each."""
        bits, genes = self._splice(rng, first, second)
        return self._mutate(rng, bits, genes)

    def _splice(self, rng: np.random.Generator, first: Population, second: Population) -> tuple[Bools, Floats]:
        pairs = len(first)
        normal = rng.normal(size=(pairs, 3))
        through = sphere_directions(self.uniform(rng, (pairs,)))  # the plane passes through a random viewpoint
        genes = np.concatenate([first.genes, second.genes], axis=1)
        bits = np.concatenate([first.bits, second.bits], axis=1)
        above = np.einsum("pnx,px->pn", sphere_directions(genes) - through[:, None], normal) > 0
        from_first = np.arange(2 * self.slots) < self.slots
        chosen = np.concatenate([bits & (above == from_first), bits & (above != from_first)])
        # Chosen cameras first, in random order; what does not fit into the slots is lost.
        order = np.argsort(rng.random(chosen.shape) + ~chosen, axis=1)[:, : self.slots]
        return np.take_along_axis(chosen, order, axis=1), np.take_along_axis(
            np.concatenate([genes, genes]), order[..., None], axis=1
        )

    def _mutate(self, rng: np.random.Generator, bits: Bools, genes: Floats) -> tuple[Bools, Floats]:
        """Nudge some cameras of half of the rows; move, add or remove one camera in the others."""
        rows = np.arange(len(bits))
        kind = rng.random(len(bits))
        size = bits.sum(axis=1)
        nudged = bits & (rng.random(bits.shape) < 1.5 / np.maximum(size, 1)[:, None]) & (kind < 0.5)[:, None]
        genes = np.where(nudged[..., None], self.nudged(rng, genes), genes)
        draw = rng.random(bits.shape)
        active = np.argmax(np.where(bits, draw, -1.0), axis=1)
        idle = np.argmax(np.where(bits, -1.0, draw), axis=1)
        elsewhere = self.uniform(rng, (len(bits),))
        moving = (kind >= 0.5) & (kind < 0.66) & (size > 0)
        genes[rows[moving], active[moving]] = elsewhere[moving]
        adding = (kind >= 0.66) & (kind < 0.83) & (size < self.slots)
        genes[rows[adding], idle[adding]] = elsewhere[adding]
        bits = bits.copy()
        bits[rows[adding], idle[adding]] = True
        removing = (kind >= 0.83) & (size > 2)
        bits[rows[removing], active[removing]] = False
        return bits, genes

    def nudged(self, rng: np.random.Generator, viewpoints: Floats) -> Floats:
        """Return viewpoints (…, d) after a step of log-uniform length in a random direction along the sphere.

        The share of the depth, where there is one, changes by up to twice the length.
        """
        shape = viewpoints.shape[:-1]
        length = np.exp(rng.uniform(np.log(SMALLEST_STEP), np.log(LARGEST_STEP), shape))
        moved = self.stepped(viewpoints, rng.uniform(-np.pi, np.pi, shape), length)
        if self.sphere.depth is None:
            return moved
        moved[..., 2] = np.clip(moved[..., 2] + 2.0 * length * rng.uniform(-1.0, 1.0, shape), 0.0, 1.0)
        return np.where(self.sphere.admissible(moved)[..., None], moved, viewpoints)

    def stepped(self, viewpoints: Floats, bearing: Floats, length: Floats) -> Floats:
        """Return viewpoints (…, d) moved by ``length`` (…) rad along great circles; bearing (…) from east to north."""
        alpha = viewpoints[..., 0]
        east = np.stack([-np.sin(alpha), np.cos(alpha), np.zeros_like(alpha)], axis=-1)
        up = sphere_directions(viewpoints)
        along = np.cos(bearing)[..., None] * east + np.sin(bearing)[..., None] * np.cross(up, east)
        moved = np.cos(length)[..., None] * up + np.sin(length)[..., None] * along
        return self.folded(np.concatenate([viewpoints_of(moved), viewpoints[..., 2:]], axis=-1))
