"""The default engine: against the plain one run 20 times longer, and after 10 s of CPU against the best known front.

Both stop at a CPU time, checked after every step; the budget in evaluations that this was is said beside the row. The
reference front is the union of everything the long runs of this benchmark found: runs of a minute of the default engine
with other seeds, the plain runs 20 times longer, and the runs that are judged. Without ``long`` it comes from the last
long run, kept in the folder for temporary files.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.placement.problem import Problem
from netdesign.search.archive import staircases
from netdesign.search.engine import Engine, hypervolume, run
from netdesign.search.state import State
from validation.benchmarks.engines import GENERATIONS, POPULATION, box_problem
from validation.benchmarks.table import Row

KEPT = Path(tempfile.gettempdir()) / "netdesign-benchmark-reference.npy"
SEEDS, REFERENCE_SEEDS = range(1, 6), range(101, 104)
SHORT, MINUTE, LONGER = 10.0, 60.0, 20
NO_LIMIT = 1_000_000  # generations: the CPU time stops the run


class _Stopped(Exception):
    pass


def within(problem: Problem, engine: Engine, seconds: float, seed: int) -> tuple[State, float]:
    """Return the state of a search after ``seconds`` of CPU, and what it took; the seeds of the search are included."""
    start, last = time.process_time(), []

    def on_step(state: State) -> None:
        last[:] = [state]
        if time.process_time() - start >= seconds:
            raise _Stopped

    try:
        run(problem, engine, POPULATION, NO_LIMIT, seed, on_step=on_step)
    except _Stopped:
        pass
    return last[0], time.process_time() - start


def rows(long: bool) -> Iterator[Row]:
    """Yield the share of the reference front; with ``long`` also the comparison with the plain engine."""
    problem = box_problem()
    run(problem, "memetic", POPULATION, 10, 0)
    found = []
    if long:
        plain = []
        for seed in SEEDS:
            start = time.process_time()
            run(problem, "nsga2", POPULATION, GENERATIONS, seed)
            plain.append(time.process_time() - start)
        one = float(np.median(plain))
        ours = [within(problem, "memetic", one, seed)[0] for seed in SEEDS]
        longer = [run(problem, "nsga2", POPULATION, LONGER * GENERATIONS, seed) for seed in SEEDS]
        volumes, theirs = _volumes(ours), _volumes(longer)
        yield Row(
            f"hypervolume, default engine with the CPU of one plain run over the plain one run {LONGER} times longer",
            1.0,
            (volumes / theirs.mean()).tolist(),
            f"five seeds: mean {volumes.mean():.4f} ({volumes.min():.4f} to {volumes.max():.4f}) after {one:.2f} s,"
            f" {_spent(ours)} evaluations; plain {theirs.mean():.4f} ({theirs.min():.4f} to {theirs.max():.4f})",
        )
        found += [state.archive.members.objectives for state in longer]
        found += [within(problem, "memetic", MINUTE, seed)[0].archive.members.objectives for seed in REFERENCE_SEEDS]
    elif KEPT.is_file():
        found.append(np.load(KEPT))
    else:
        yield Row("share of the reference front: no reference yet, run with --long", None, [])
        return
    runs = [within(problem, "memetic", SHORT, seed) for seed in SEEDS]
    states = [state for state, _ in runs]
    reference = _union(found + [state.archive.members.objectives for state in states])
    np.save(KEPT, reference)
    best = hypervolume(problem, reference)
    yield Row(
        f"share of the reference front's hypervolume after {SHORT:g} s of CPU",
        0.97,
        (_volumes(states) / best).tolist(),
        f"reference {best:.4f}, {len(reference)} networks; {_spent(states)} evaluations in"
        f" {np.mean([seconds for _, seconds in runs]):.1f} s",
    )


def _volumes(states: list[State]) -> Floats:
    return np.array([state.hypervolume[-1] for state in states])


def _spent(states: list[State]) -> int:
    return int(np.mean([state.evaluations[-1] for state in states]))


def _union(parts: list[Floats]) -> Floats:
    everything = np.concatenate(parts)
    return everything[staircases(everything, 0.0)]
