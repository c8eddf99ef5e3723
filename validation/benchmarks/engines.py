"""The engines against pymoo and against each other: a box with 50 tags, workspace motion, n = 30."""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from pymoo.algorithms.moo.nsga2 import NSGA2
from pymoo.core.problem import Problem as PymooProblem
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.sampling.rnd import FloatRandomSampling
from pymoo.optimize import minimize

from netdesign.model.study import Study
from netdesign.model.task import Task
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.placement.problem import Problem
from netdesign.search.engine import run
from tests.scenes import CAMERA, LIMITS, box_scene, sphere
from validation.benchmarks.table import Row

IMAGES, POPULATION = 30, 200


def box_problem() -> Problem:
    """Return the benchmark's study: five faces of a box, at least two rays per point."""
    study = Study.model_validate(
        {
            "format": 1,
            "name": "benchmark",
            "part": {"mesh": "none"},
            "targets": {"size_mm": 20, "spacing_mm": 50},
            "camera": {"width_px": 1, "height_px": 1, "focal_px": [1, 1], "principal_point_px": [0, 0]},
            "viewpoints": {"radius_mm": 600, "max_images": IMAGES},
        }
    )
    scene = box_scene(spacing=0.06)
    limits = replace(LIMITS, min_rays=2)
    return Problem.build(
        Task(
            study=study,
            scene=scene,
            camera=CAMERA,
            sphere=sphere(max_images=IMAGES),
            limits=limits,
            cell=None,
            sha256="",
        )
    )


class Wrapped(PymooProblem):
    """The study for pymoo: n numbers in [0, 1] that are bits above one half, then the angles."""

    def __init__(self, problem: Problem) -> None:
        lower, upper = problem.chromosomes.bounds
        super().__init__(
            n_var=3 * IMAGES, n_obj=3, n_ieq_constr=1,
            xl=np.r_[np.zeros(IMAGES), np.tile(lower, IMAGES)], xu=np.r_[np.ones(IMAGES), np.tile(upper, IMAGES)],
        )  # fmt: skip
        self.inner = problem

    def _evaluate(self, x, out, *args, **kwargs):
        bits, genes = x[:, :IMAGES] > 0.5, x[:, IMAGES:].reshape(len(x), IMAGES, 2)
        objectives, violation = self.inner.evaluate(bits, genes)
        out["F"] = np.where(np.isfinite(objectives), objectives, 1e9)
        out["G"] = violation[:, None]


def pymoo_seconds(problem: Problem, generations: int, seed: int) -> float:
    """CPU seconds of pymoo's NSGA-II, SBX and polynomial mutation, with our kernel."""
    algorithm = NSGA2(
        pop_size=POPULATION, sampling=FloatRandomSampling(), crossover=SBX(prob=0.9, eta=15), mutation=PM(eta=20)
    )
    start = time.process_time()
    minimize(Wrapped(problem), algorithm, ("n_gen", generations), seed=seed, verbose=False)
    return time.process_time() - start


def numpy_seconds(problem: Problem, networks: int = 20) -> float:
    """CPU seconds of one evaluation by numpy: precision only, so in favour of the other side."""
    rng = np.random.default_rng(0)
    bits, genes = problem.random(rng, networks)
    points = problem.task.scene.targets.points
    start = time.process_time()
    for row in range(networks):
        viewpoints = genes[row][bits[row]]
        visible = np.repeat(problem.visibility.sure_tags(problem.visibility.cell_of(viewpoints)), 4, axis=1)
        limited_covariance(problem.task.sphere.cameras(viewpoints), points, CAMERA.intrinsics, visible, 0.1)
    return (time.process_time() - start) / networks


def timed(problem: Problem, engine: str, generations: int, seed: int) -> tuple[float, float]:
    """CPU seconds and final hypervolume of one run."""
    start = time.process_time()
    state = run(problem, engine, POPULATION, generations, seed)
    return time.process_time() - start, float(state.hypervolume[-1])


def rows(long: bool) -> Iterator[Row]:
    """Yield the rows of the engines at 200 x 500; ``long``: five seeds and the runs 20 times longer."""
    problem = replace(box_problem(), threads=1)
    generations, seeds = 500, range(1, 6) if long else range(1, 4)
    for engine in ("nsga2", "memetic"):
        timed(problem, engine, 3, 0)
    pymoo_seconds(problem, 3, 0)
    plain, other = [], []
    for seed in seeds:
        plain.append(timed(problem, "nsga2", generations, seed))
        other.append(pymoo_seconds(problem, generations, seed))
    times = [seconds for seconds, _ in plain]
    seconds = float(np.median(times))
    ratios = [slow / fast for slow, fast in zip(other, times, strict=True)]
    yield Row(f"NSGA-II {POPULATION} x {generations} against pymoo, same kernel", 4.0, ratios)
    slow_each = numpy_seconds(problem)
    with_numpy = [(slow + slow_each * POPULATION * generations) / fast for slow, fast in zip(other, times, strict=True)]
    yield Row("NSGA-II against pymoo with numpy evaluation (one evaluation measured)", 40.0, with_numpy)
    if not long:
        return
    budget = generations
    for _ in range(3):  # the memetic budget that takes the CPU of one plain run
        taken = float(np.median([timed(problem, "memetic", budget, seed)[0] for seed in (11, 12, 13)]))
        budget = max(5, int(budget * seconds / taken))
    memetic = [timed(problem, "memetic", budget, seed) for seed in seeds]
    longer = [timed(problem, "nsga2", 20 * generations, seed) for seed in seeds]
    ours, theirs = np.mean([volume for _, volume in memetic]), np.mean([volume for _, volume in longer])
    yield Row("mean hypervolume, default engine over the plain one run 20 times longer", 1.0, [float(ours / theirs)])
    taken = np.mean([spent for spent, _ in memetic])
    yield Row(f"default {taken:.2f} s: {ours:.4f}, plain {seconds:.2f} s, 20 times longer: {theirs:.4f}", None, [])
