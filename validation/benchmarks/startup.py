"""What a first and a later start of ``netdesign design`` on the quick study cost: CPU seconds of own processes.

Cold: nothing compiled, no joint map, no visibility map. Warm: the same command once more.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from validation.benchmarks.table import Row

ROOT = Path(__file__).resolve().parents[2]
STUDY = ROOT / "datasets" / "studies" / "quick.toml"
WATCHED = """
import json, sys, time
from netdesign import cli, design
from numba.core import event

spent = {"compile": 0.0, "kernels": 0, "search": 0.0}


class Compilation(event.Listener):
    depth, start = 0, 0.0

    def on_start(self, _):
        if self.depth == 0:
            self.start = time.process_time()
        self.depth += 1

    def on_end(self, _):
        self.depth -= 1
        if self.depth == 0:
            spent["compile"] += time.process_time() - self.start
            spent["kernels"] += 1


def timed(*arguments, search=design.search, **options):
    start = time.process_time()
    try:
        return search(*arguments, **options)
    finally:
        spent["search"] += time.process_time() - start


event.register("numba:compile", Compilation())
design.search = timed
cli.app(["design", sys.argv[1], "-o", sys.argv[2], "--threads", "1"], standalone_mode=False)
open(sys.argv[3], "w").write(json.dumps(spent))
"""


class Start(NamedTuple):
    """CPU s of one start: of the command as a whole, of compiling, of the search; kernels: how many were compiled."""

    whole: float
    compile: float
    search: float
    kernels: int


def rows(repeats: int) -> Iterator[Row]:
    """Yield the rows of cold and warm start; two cold ones are enough, each takes half a minute."""
    cold, warm = [], []
    for _ in range(min(repeats, 2)):
        with tempfile.TemporaryDirectory() as folder:
            cold.append(started(Path(folder), "cold"))
            warm += [started(Path(folder), f"warm{number}") for number in range(repeats)]
    whole, kernels = min(start.whole for start in cold), cold[0].kernels
    note = f"{kernels} kernels; the whole command {whole:.1f} s"
    yield Row(
        "cold start of quick.toml: CPU s of compiling", 20.0, [start.compile for start in cold], note, at_most=True
    )
    recompiled = sum(start.kernels for start in warm)
    note = f"{recompiled} kernels compiled again"
    yield Row(
        "warm start of quick.toml: CPU s of the search", 2.0, [start.search for start in warm], note, at_most=True
    )
    yield Row("warm start of quick.toml: CPU s of the whole command", None, [start.whole for start in warm])


def started(folder: Path, name: str) -> Start:
    """Run the command in a process of its own, on one thread, with its caches in ``folder``."""
    caches = {"NUMBA_CACHE_DIR": str(folder / "numba"), "XDG_CACHE_HOME": str(folder / "cache")}
    single = {variable: "1" for variable in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")}
    environment = {**os.environ, **caches, **single, "PYTHONPATH": str(ROOT)}
    spent = folder / f"{name}.json"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-c", WATCHED, str(STUDY), str(folder / name), str(spent)],
        env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Start(whole=whole, **json.loads(spent.read_text(encoding="utf-8")))
