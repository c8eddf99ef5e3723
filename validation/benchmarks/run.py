"""All speed and quality ratios of the search, one process, one thread, CPU time: python validation/benchmarks/run.py.

Ratios inside one run are what counts; the machine's load moves the absolute times. ``--repeats`` for steadier medians,
``--long`` for the comparisons between engines at full length (a quarter of an hour).
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numba

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the scene, and the package of this checkout

from validation.benchmarks import engines, kernels, motion, standard


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
    """Run the benchmarks and print one line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--only", nargs="*", help="of: kernels tours motion engines standard")
    options = parser.parse_args()
    numba.set_num_threads(1)
    chosen = options.only or ["kernels", "tours", "motion", "engines", "standard"]
    with tempfile.TemporaryDirectory() as folder:
        if "kernels" in chosen:
            sides = kernels.Sides(Path(folder))
            ours, numpy_side = cpu(sides.ours, options.repeats), cpu(sides.textbook, options.repeats)
            if sides.has_c:
                c_side = cpu(sides.c, options.repeats)
                print(f"limited-error kernel, speed relative to C (>= 0.75)   {ratio(c_side, ours)}")
            scale = sides.textbook_share
            print(
                f"limited-error kernel against textbook numpy (>= 100)  {ratio([t * scale for t in numpy_side], ours)}"
            )
        if "tours" in chosen:
            for n in (20, 30):
                for line in kernels.tours(n, cpu, ratio, options.repeats):
                    print(line)
        if "motion" in chosen:
            for line in motion.lines(cpu, ratio, options.repeats):
                print(line)
        if "engines" in chosen:
            for line in engines.lines(options.long):
                print(line)
        if "standard" in chosen:
            for line in standard.lines(10 if options.long else 3):
                print(line)


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as problem:
        sys.exit(f"gcc failed: {problem}")
