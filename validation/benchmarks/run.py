"""All speed and quality ratios of the search, one process, one thread, CPU time: python validation/benchmarks/run.py.

Ratios inside one run are what counts; the machine's load moves the absolute times. ``--repeats`` for steadier medians,
``--long`` for the comparisons between engines at full length (a quarter of an hour), ``--only`` for some parts. Every
part that ends is stored in results.json and in the README's table at once; parts that did not run keep their rows.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"  # before numpy is loaded

import numba

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the scene, and the package of this checkout

from validation.benchmarks import engines, kernels, motion, quality, scaling, standard, startup, total
from validation.benchmarks.table import Row, store


def main() -> None:
    """Run the chosen parts, print their rows, keep them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--only", nargs="+", metavar="PART", choices=list(PARTS), help=f"of: {' '.join(PARTS)}")
    options = parser.parse_args()
    numba.set_num_threads(1)
    missed = []
    for part in options.only or PARTS:
        print(part, flush=True)
        rows = []
        for row in PARTS[part](options.repeats, options.long):
            print(row, flush=True)
            rows.append(row)
        store(part, rows, options.long)
        missed += [row.what for row in rows if row.holds is False]
    print(f"does not hold: {'; '.join(missed)}" if missed else "every row that ran holds")


def limited(repeats: int, long: bool) -> Iterator[Row]:
    """Yield the rows of the limited-error kernel."""
    with tempfile.TemporaryDirectory() as folder:
        sides = kernels.Sides(Path(folder))
        if not sides.has_c:
            yield Row("gcc is not there: no comparison with C", None, [])
        chosen = [sides.ours, sides.textbook] + ([sides.c] if sides.has_c else [])
        # Calls of a few ms: many of them, side by side.
        times = [[cpu(side) for side in chosen] for _ in range(3 * repeats)]
    if sides.has_c:
        yield Row("limited-error kernel, speed relative to C", 0.75, [row[2] / row[0] for row in times])
    ratios = [sides.textbook_share * row[1] / row[0] for row in times]
    yield Row("limited-error kernel against textbook numpy", 100.0, ratios)


def cpu(work: Callable[[], object]) -> float:
    """CPU seconds of a call after one that is not counted."""
    work()
    start = time.process_time()
    work()
    return time.process_time() - start


def tours(repeats: int, long: bool) -> Iterator[Row]:
    """Yield the rows on tours in the workspace."""
    yield from kernels.tours(20, repeats)
    yield from kernels.tours(30, repeats)
    yield from kernels.small_tours()


PARTS: dict[str, Callable[[int, bool], Iterator[Row]]] = {
    "kernels": limited,
    "total": lambda repeats, long: total.rows(repeats),
    "tours": tours,
    "motion": lambda repeats, long: motion.rows(repeats),
    "engines": lambda repeats, long: engines.rows(long),
    "quality": lambda repeats, long: quality.rows(long),
    "startup": lambda repeats, long: startup.rows(repeats),
    "scaling": lambda repeats, long: scaling.rows(repeats),
    "standard": lambda repeats, long: standard.rows(10 if long else 3),
}


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as problem:
        sys.exit(f"gcc failed: {problem}")
