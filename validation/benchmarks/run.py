"""All speed and quality ratios of the search, one process, one thread, CPU time: python validation/benchmarks/run.py.

Ratios inside one run are what counts; the machine's load moves the absolute times. ``--repeats`` for steadier medians,
``--long`` for the comparisons between engines at full length (a quarter of an hour).
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"  # before numpy is loaded

import numba

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the scene, and the package of this checkout

from validation.benchmarks import engines, kernels, motion, standard, total
from validation.benchmarks.table import Row, store


def cpu(work: Callable[[], object], repeats: int) -> list[float]:
    """CPU seconds of ``repeats`` calls after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return times


def ratio(slow: list[float], fast: list[float]) -> str:
    """Median of the ratios of calls made side by side, and their range."""
    pairs = [a / b for a, b in zip(slow, fast, strict=True)]
    return f"{statistics.median(pairs):8.2f}   ({min(pairs):.2f} to {max(pairs):.2f})"


def main() -> None:
    """Run the benchmarks, print one line each, keep the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--only", nargs="*", help="of: kernels total tours motion engines standard")
    options = parser.parse_args()
    numba.set_num_threads(1)
    chosen = options.only or ["kernels", "total", "tours", "motion", "engines", "standard"]
    rows = []
    for row in measured(chosen, options.repeats, options.long):
        print(row, flush=True)
        rows.append(row)
    store(rows)


def measured(chosen: list[str], repeats: int, long: bool) -> Iterator[Row]:
    """Yield the rows of the chosen parts."""
    if "kernels" in chosen:
        with tempfile.TemporaryDirectory() as folder:
            sides = kernels.Sides(Path(folder))
            # Calls of a few ms: many of them, side by side.
            triples = [[cpu(side, 1)[0] for side in (sides.ours, sides.c, sides.textbook)] for _ in range(3 * repeats)]
        yield Row("limited-error kernel, speed relative to C", 0.75, [c / ours for ours, c, _ in triples])
        ratios = [sides.textbook_share * slow / ours for ours, _, slow in triples]
        yield Row("limited-error kernel against textbook numpy", 100.0, ratios)
    if "total" in chosen:
        yield from total.rows(repeats)
    if "tours" in chosen:
        yield from kernels.tours(20, repeats)
        yield from kernels.tours(30, repeats)
        yield from kernels.small_tours()
    if "motion" in chosen:
        yield from (Row(line, None, []) for line in motion.lines(cpu, ratio, repeats))
    if "engines" in chosen:
        yield from engines.rows(long)
    if "standard" in chosen:
        yield from (Row(line, None, []) for line in standard.lines(10 if long else 3))


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as problem:
        sys.exit(f"gcc failed: {problem}")
