"""How evaluation and search grow with images n, object points m and population P: printed, and drawn in scaling.png.

Networks of n images on the benchmark's box, every one feasible: a cover first, the rest at random. One of n, m, P
changes at a time; the others stay at 30, 216 and 200. The networks of a search have about half of the n images.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from netdesign.placement.problem import Problem
from netdesign.reporting.palette import ACHIEVED, PREDICTED_TOTAL
from netdesign.search.engine import run
from validation.benchmarks.engines import IMAGES, POPULATION, box_problem
from validation.benchmarks.table import Row

PICTURE = Path(__file__).with_name("scaling.png")
SIZES = [8, 12, 16, 20, 30, 45, 60]  # images; six cover the box
SPACINGS = [0.09, 0.06, 0.045, 0.03, 0.02]  # m between tags
POPULATIONS = [20, 50, 200, 1000, 5000]
TAG_SIZE = 0.012
GENERATIONS = 6  # of the timed searches
EVALUATION, SEARCH = "evaluation", "search, plain engine"


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Times (k,) in µs per network over sizes (k,), for both kinds of work."""

    of: str
    sizes: list[int]
    times: dict[str, list[float]]

    def exponent(self, kind: str) -> float:
        """Return the slope in logarithms over the upper half of the sizes, where constant costs matter least."""
        half = len(self.sizes) // 2
        return float(np.polyfit(np.log(self.sizes[half:]), np.log(self.times[kind][half:]), 1)[0])


def rows(repeats: int) -> Iterator[Row]:
    """Yield the exponents and draw the curves."""
    whole = box_problem(max(SIZES))
    problems = [box_problem(IMAGES, spacing, TAG_SIZE) for spacing in SPACINGS]
    points = [len(problem.task.scene.targets.points) for problem in problems]
    usual = box_problem()
    curves = [
        _curve("n", SIZES, lambda size: (box_problem(size) if size != max(SIZES) else whole, POPULATION), repeats),
        _curve("m", points, lambda size: (problems[points.index(size)], POPULATION), repeats),
        _curve("P", POPULATIONS, lambda size: (usual, size), repeats),
    ]
    for curve in curves:
        half = curve.sizes[len(curve.sizes) // 2]
        for kind, times in curve.times.items():
            yield Row(
                f"time per network, {kind}: exponent in {curve.of} from {half} to {curve.sizes[-1]}",
                None,
                [curve.exponent(kind)],
                ", ".join(f"{curve.of} {size}: {micro:.1f} us" for size, micro in zip(curve.sizes, times, strict=True)),
            )
    draw(curves)


def _curve(of: str, sizes: list[int], case: Callable[[int], tuple[Problem, int]], repeats: int) -> Curve:
    """The medians of ``repeats`` rounds over all sizes: the load of the machine meets every size."""
    cases = [case(size) for size in sizes]
    rounds = [[(_evaluation(*one), _search(*one)) for one in cases] for _ in range(repeats)]
    evaluation, search = np.median(1e6 * np.array(rounds), axis=0).T.tolist()
    return Curve(of=of, sizes=sizes, times={EVALUATION: evaluation, SEARCH: search})


def _evaluation(problem: Problem, population: int) -> float:
    """CPU seconds per network of evaluations of feasible networks with all images."""
    slots, cover = problem.chromosomes.slots, problem.cover.viewpoints
    genes = problem.chromosomes.uniform(np.random.default_rng(0), (4 * population, slots))
    genes[:, : len(cover)] = cover
    bits = np.ones(genes.shape[:2], np.bool_)
    _, violation = problem.evaluate(bits, genes)
    genes, bits = genes[violation <= 0][:population], bits[:population]  # the images of some do not hang together
    if len(genes) < population:
        raise RuntimeError("expected feasible networks: they contain the cover")
    calls = max(1, 2000 // population)
    start = time.process_time()
    for _ in range(calls):
        problem.evaluate(bits, genes)
    return (time.process_time() - start) / (calls * population)


def _search(problem: Problem, population: int) -> float:
    """CPU seconds per evaluation of the plain engine from a random start."""
    generations = max(GENERATIONS, 2000 // population)
    start = time.process_time()
    run(problem, "nsga2", population, generations, 1)
    return (time.process_time() - start) / (population * generations)


def draw(curves: list[Curve]) -> None:
    """Write scaling.png: a panel per curve, both axes logarithmic."""
    figure = Figure(figsize=(10, 3.4), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    names = {"n": "images n", "m": "object points m", "P": "population P"}
    panels = figure.subplots(1, len(curves))
    for axes, curve in zip(panels, curves, strict=True):
        for (kind, times), color in zip(curve.times.items(), (PREDICTED_TOTAL, ACHIEVED), strict=True):
            label = f"{kind}: exponent {curve.exponent(kind):.2f}"
            axes.loglog(curve.sizes, times, "o-", color=color, label=label, markersize=4)
        axes.set_xticks(curve.sizes, [str(size) for size in curve.sizes], rotation=45)
        axes.minorticks_off()
        axes.set_xlabel(names[curve.of])
        axes.set_ylim(bottom=0.5 * min(min(times) for one in curves for times in one.times.values()))
        axes.set_ylim(top=2.0 * max(max(times) for one in curves for times in one.times.values()))
        axes.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    panels[0].set_ylabel("CPU time per network [µs]")
    figure.savefig(PICTURE, metadata={"Software": None})
