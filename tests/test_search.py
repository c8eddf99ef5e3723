"""The search on plain arrays: sorting, crowding, archive, operators, engines, resume."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymoo.operators.survival.rank_and_crowding.metrics import calc_crowding_distance
from pymoo.util.nds.non_dominated_sorting import NonDominatedSorting

from netdesign.errors import InputError
from netdesign.search.archive import non_dominated, staircases
from netdesign.search.engine import hypervolume, offspring, run
from netdesign.search.operators import flip_bits, polynomial_mutation, raised, root, sbx, uniform_crossover
from netdesign.search.population import evaluated, joined
from netdesign.search.selection import constrained_ranks, crowding, ranked, tournament
from netdesign.search.state import load, save


def brute_ranks(objectives, violation):
    """Constrained domination, front by front, straight from its definition."""
    count = len(objectives)

    def dominates(a, b):
        if violation[a] > 0 or violation[b] > 0:
            return violation[a] < violation[b] if max(violation[a], violation[b]) > 0 else False
        return (objectives[a] <= objectives[b]).all() and (objectives[a] < objectives[b]).any()

    ranks, left, front = np.full(count, -1), set(range(count)), 0
    while left:
        best = [a for a in left if not any(dominates(b, a) for b in left)]
        for a in best:
            ranks[a] = front
        left -= set(best)
        front += 1
    return ranks


@given(st.integers(0, 10**6), st.integers(1, 40))
@settings(deadline=None, max_examples=60)
def test_sorting_equals_brute_force(seed, count):
    rng = np.random.default_rng(seed)
    objectives = rng.integers(0, 6, (count, 3)).astype(float)  # many ties
    violation = np.where(rng.random(count) < 0.4, rng.integers(1, 4, count), 0).astype(float)
    np.testing.assert_array_equal(constrained_ranks(objectives, violation), brute_ranks(objectives, violation))


@given(st.integers(0, 10**6))
@settings(deadline=None, max_examples=20)
def test_crowding_equals_pymoo_on_one_front(seed):
    objectives = np.random.default_rng(seed).random((30, 3))
    front = NonDominatedSorting().do(objectives)[0]
    ours = crowding(objectives[front], np.zeros(len(front), dtype=np.int64))
    # pymoo divides by the number of objectives.
    theirs = calc_crowding_distance(objectives[front])
    np.testing.assert_array_equal(np.isinf(ours), np.isinf(theirs))
    inner = np.isfinite(ours)
    np.testing.assert_allclose(ours[inner], 3 * theirs[inner], rtol=1e-9)


@given(st.integers(0, 10**6), st.integers(1, 60))
@settings(deadline=None, max_examples=30)
def test_crowding_of_several_fronts_is_that_of_each_alone(seed, count):
    rng = np.random.default_rng(seed)
    objectives, ranks = rng.integers(0, 9, (count, 3)).astype(float), rng.integers(0, 4, count)
    together = crowding(objectives, ranks)
    for front in np.unique(ranks):
        rows = ranks == front
        np.testing.assert_allclose(together[rows], crowding(objectives[rows], np.zeros(rows.sum(), np.int64)))


@given(st.integers(0, 10**6), st.integers(1, 120), st.sampled_from([0.0, 0.01, 0.2]))
@settings(deadline=None, max_examples=60)
def test_archives_are_strict_staircases_within_epsilon(seed, count, epsilon):
    rng = np.random.default_rng(seed)
    objectives = np.column_stack([rng.uniform(0.5, 2, (count, 2)).round(2), rng.integers(2, 5, count)])
    kept = staircases(objectives, epsilon)
    for size in np.unique(objectives[:, 2]):
        layer = objectives[kept][objectives[kept][:, 2] == size]
        everything = objectives[objectives[:, 2] == size]
        assert (np.diff(layer[:, 0]) > 0).all()
        assert (np.diff(layer[:, 1]) < 0).all()
        for row in everything:  # something kept is at least as good, but for the width of two boxes
            assert (layer[:, :2] <= row[:2] * (1 + epsilon) ** 2 * (1 + 1e-12)).all(axis=1).any()
        np.testing.assert_allclose(layer[0, 0], everything[:, 0].min())
        np.testing.assert_allclose(layer[-1, 1], everything[:, 1].min())


@given(st.integers(0, 10**6), st.integers(1, 60))
@settings(deadline=None, max_examples=40)
def test_non_dominated_equals_brute_force(seed, count):
    objectives = np.random.default_rng(seed).integers(0, 5, (count, 3)).astype(float)
    kept = non_dominated(objectives)
    ranks = brute_ranks(objectives, np.zeros(count))
    assert {tuple(row) for row in objectives[kept]} == {tuple(row) for row in objectives[ranks == 0]}
    assert len({tuple(row) for row in objectives[kept]}) == len(kept)


def test_operators_keep_bounds_and_means():
    rng = np.random.default_rng(0)
    lower, upper = np.array([0.0, -3.0]), np.array([1.0, 5.0])
    first, second = rng.uniform(lower, upper, (4000, 2)), rng.uniform(lower, upper, (4000, 2))
    children = sbx(rng, first, second, lower, upper, 0.9, 15)
    assert ((children >= lower) & (children <= upper)).all()
    moved = children.mean(axis=0) - 0.5 * (first + second).mean(axis=0)
    assert (np.abs(moved) < 0.03 * (upper - lower)).all()
    mutants = polynomial_mutation(rng, first, lower, upper, 1.0, 20)
    assert ((mutants >= lower) & (mutants <= upper)).all()
    assert 0.02 < (np.abs(mutants - first) / (upper - lower)).mean() < 0.1


def test_bits_cross_and_flip_as_often_as_they_should():
    """Of n bits that differ a share p/2 changes sides; four standard deviations of pairs and bits are allowed."""
    rng, pairs, n = np.random.default_rng(1), 4000, 30
    first, second = np.zeros((pairs, n), bool), np.ones((pairs, n), bool)
    children = uniform_crossover(rng, first, second, 0.9)
    assert (children[:pairs] ^ children[pairs:]).all()  # each bit goes to one child
    assert children[:pairs].mean() == pytest.approx(0.45, abs=4 * np.sqrt((0.09 / 4 + 0.25 / n) / pairs))
    assert children[:pairs].any(axis=1).mean() == pytest.approx(0.9, abs=4 * np.sqrt(0.09 / pairs))
    flips = flip_bits(rng, first, 1 / 30).mean()
    assert flips == pytest.approx(1 / 30, abs=4 * np.sqrt(1 / 30 / first.size))


@given(st.integers(0, 10**6), st.integers(1, 15), st.integers(1, 6), st.integers(0, 30))
@settings(deadline=None, max_examples=40)
def test_everybody_competes_equally_often(seed, pairs, rounds, more):
    """The best wins all of its tournaments, the worst none, and nobody enters more of them than there are rounds."""
    rng = np.random.default_rng(seed)
    ranks = rng.permutation(2 * pairs)
    wins = np.bincount(tournament(rng, ranks, np.zeros(2 * pairs), rounds * pairs), minlength=2 * pairs)
    assert wins[ranks.argmin()] == rounds == wins.max()
    assert wins[ranks.argmax()] == 0
    odd = tournament(rng, np.arange(2 * pairs + 1), np.zeros(2 * pairs + 1), more)
    assert len(odd) == more
    assert np.bincount(odd, minlength=1).max() <= -(-2 * more // (2 * pairs + 1))


def test_no_child_is_a_copy():
    """Half of what is bred here are copies of the parents; none is kept, unless nothing else exists."""

    class Lazy(Dots):
        def vary_plain(self, rng, first, second):
            bits, genes = super().vary_plain(rng, first, second)
            copied = rng.random(len(bits)) < 0.5
            both = np.concatenate([first.bits, second.bits]), np.concatenate([first.genes, second.genes])
            return np.where(copied[:, None], both[0], bits), np.where(copied[:, None, None], both[1], genes)

    class Barren(Dots):
        def vary_plain(self, rng, first, second):
            return np.concatenate([first.bits, second.bits]), np.concatenate([first.genes, second.genes])

    rng = np.random.default_rng(0)
    for problem, copies in ((Lazy(), 0), (Barren(), 20)):
        population = evaluated(problem.evaluate, *problem.random(rng, 20))
        children = offspring(rng, problem, population, *ranked(population), problem.vary_plain)
        together = joined([population, children])
        rows = np.concatenate([together.bits, together.genes[..., 0]], axis=1)
        assert len(children) == 20
        assert len(rows) - len(np.unique(rows, axis=0)) == copies


@given(st.floats(1e-6, 1e3), st.sampled_from([1.0, 2.0, 16.0, 21.0, 3.5, 0.5]))
def test_powers_and_roots_by_squaring(value, exponent):
    np.testing.assert_allclose(raised(np.array([value]), exponent), value**exponent, rtol=1e-13)
    np.testing.assert_allclose(root(np.array([value]), exponent), value ** (1 / exponent), rtol=1e-13)


class Dots:
    """A toy with sizes: place k dots on a line; few dots, far from 0.3, near to each other."""

    slots = 6

    def evaluate(self, bits, genes):
        size = bits.sum(axis=1)
        x = genes[..., 0]
        far = np.where(bits, (x - 0.3) ** 2, 0).sum(axis=1) / np.maximum(size, 1) + 0.1 / np.maximum(size, 1)
        length = np.where(bits, np.abs(x - 0.8), 0).sum(axis=1) + 0.01
        return np.column_stack([far, length, size]), np.maximum(2.0 - size, 0.0)

    def random(self, rng, count):
        return rng.random((count, self.slots)) < 0.5, rng.random((count, self.slots, 1))

    def seeds(self):
        return np.ones((1, self.slots), bool), np.full((1, self.slots, 1), 0.3)

    def vary_plain(self, rng, first, second):
        genes = sbx(rng, first.genes[..., 0], second.genes[..., 0], np.zeros(6), np.ones(6), 0.9, 15)
        genes = polynomial_mutation(rng, genes, np.zeros(6), np.ones(6), 0.2, 20)
        bits = np.concatenate([first.bits, second.bits]) ^ (rng.random(genes.shape) < 0.1)
        return bits, genes[..., None]

    vary_structured = vary_plain

    def improve(self, rng, members, preference):
        from netdesign.search.population import evaluated

        genes = np.clip(np.repeat(members.genes, 10, axis=0) + rng.normal(0, 0.02, (10 * len(members), 6, 1)), 0, 1)
        return evaluated(self.evaluate, np.repeat(members.bits, 10, axis=0), genes)

    def normalise(self, objectives):
        return objectives / np.array([1.0, 6.0, 7.0])


@pytest.mark.parametrize("engine", ["nsga2", "memetic"])
def test_engines_improve_resume_and_repeat(engine, tmp_path):
    problem = Dots()
    states = []
    final = run(problem, engine, 20, 30, 5, on_step=states.append)
    assert final.evaluations[-1] >= 600
    assert (np.diff(final.evaluations) > 0).all()
    # Thinning may give up to a box's width of volume back, no more.
    assert (np.diff(final.hypervolume) > -0.01).all()
    assert final.hypervolume[-1] > final.hypervolume[0] + 0.02
    assert hypervolume(problem, final.archive.members.objectives) == final.hypervolume[-1]
    again = run(problem, engine, 20, 30, 5)
    for at in (0, len(states) // 2, len(states) - 1):
        save(tmp_path / "state.npz", states[at], "key")
        resumed = run(problem, engine, 20, 30, 5, resume=load(tmp_path / "state.npz", "key"))
        for other in (again, resumed):
            assert other.archive.members.genes.tobytes() == final.archive.members.genes.tobytes()
            assert other.archive.members.objectives.tobytes() == final.archive.members.objectives.tobytes()
            assert other.hypervolume.tobytes() == final.hypervolume.tobytes()
            assert other.random == final.random
    with pytest.raises(InputError, match="another"):
        load(tmp_path / "state.npz", "other")
    (tmp_path / "state.npz").write_bytes(b"broken")
    with pytest.raises(InputError, match="readable"):
        load(tmp_path / "state.npz", "key")
    assert list(tmp_path.iterdir()) == [tmp_path / "state.npz"]


def test_parents_that_are_crossed_late_are_neighbours_on_the_front():
    """Of sizes next to each other, and within a fifth of the staircase, whatever its length; both ends take part."""
    pairs = []

    class Watched(Dots):
        def vary_structured(self, rng, first, second):
            pairs.append((first, second))
            return super().vary_structured(rng, first, second)

    states = []
    run(Watched(), "memetic", 20, 60, 5, on_step=states.append)
    late = [(first, second) for first, second in pairs if len(first) == 80]
    assert len(late) >= 3
    archives = [state.archive for state in states]
    for first, second in late:
        archive = next(
            archive for archive in archives
            if {row.tobytes() for row in first.objectives} <= {row.tobytes() for row in archive.members.objectives}
        )  # fmt: skip
        sizes, starts, counts = np.unique(archive.sizes, return_index=True, return_counts=True)
        row_of = {row.tobytes(): index for index, row in enumerate(archive.members.objectives)}
        one, two = (np.array([row_of[row.tobytes()] for row in parents.objectives]) for parents in (first, second))
        layer_one, layer_two = (np.searchsorted(starts, rows, side="right") - 1 for rows in (one, two))
        assert np.abs(layer_one - layer_two).max() <= 1
        place_one, place_two = (
            (rows - starts[layer]) / counts[layer] for rows, layer in ((one, layer_one), (two, layer_two))
        )
        slack = 1 / counts[layer_one] + 1 / counts[layer_two]
        assert (np.abs(place_one - place_two) <= 0.2 + slack).all()
        assert len(np.unique(layer_one)) == len(sizes)
