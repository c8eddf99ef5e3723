"""NSGA-II against pymoo's, with our kernel and with numpy evaluation: a box with tags, n = 30 images."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from pymoo.algorithms.moo.nsga2 import NSGA2
from pymoo.core.problem import Problem as PymooProblem
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.sampling.rnd import FloatRandomSampling
from pymoo.optimize import minimize

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import sphere_directions
from netdesign.model.study import Study
from netdesign.model.task import Task
from netdesign.motion.tour import nearest_neighbour_3opt
from netdesign.placement.problem import Problem
from netdesign.search.engine import run
from tests.scenes import CAMERA, LIMITS, box_scene, sphere
from validation.benchmarks.kernels import mean_variance_by_numpy
from validation.benchmarks.table import Row

IMAGES, POPULATION, GENERATIONS, SLICE = 30, 200, 500, 20


def box_problem(images: int = IMAGES, spacing: float = 0.06, tag_size: float = 0.02) -> Problem:
    """Return the benchmark's study: five faces of a box, at least two rays per point, motion in the workspace.

    Args:
        images: at most.  spacing: m between the tags; 0.06 makes 50.  tag_size: m.
    """
    study = Study.model_validate(
        {
            "format": 1,
            "name": "benchmark",
            "part": {"mesh": "none"},
            "targets": {"size_mm": 20, "spacing_mm": 50},
            "camera": {"width_px": 1, "height_px": 1, "focal_px": [1, 1], "principal_point_px": [0, 0]},
            "viewpoints": {"radius_mm": 600, "max_images": images},
        }
    )
    scene = box_scene(spacing=spacing, tag_size=tag_size)
    limits = replace(LIMITS, min_rays=2)
    task = Task(
        study=study, scene=scene, camera=CAMERA, sphere=sphere(max_images=images), limits=limits, cell=None, sha256=""
    )
    return replace(Problem.build(task), threads=1)


Evaluate = Callable[[Bools, Floats], tuple[Floats, Floats]]


class Wrapped(PymooProblem):
    """The study for pymoo: n numbers in [0, 1] that are bits above one half, then the angles."""

    def __init__(self, problem: Problem, evaluate: Evaluate) -> None:
        lower, upper = problem.chromosomes.bounds
        super().__init__(
            n_var=3 * IMAGES, n_obj=3, n_ieq_constr=1,
            xl=np.r_[np.zeros(IMAGES), np.tile(lower, IMAGES)], xu=np.r_[np.ones(IMAGES), np.tile(upper, IMAGES)],
        )  # fmt: skip
        self.evaluated = evaluate

    def _evaluate(self, x, out, *args, **kwargs):
        bits, genes = x[:, :IMAGES] > 0.5, x[:, IMAGES:].reshape(len(x), IMAGES, 2)
        objectives, violation = self.evaluated(bits, genes)
        out["F"] = np.where(np.isfinite(objectives), objectives, 1e9)
        out["G"] = violation[:, None]


def by_numpy(problem: Problem) -> Evaluate:
    """Return an evaluation by numpy broadcasting, network by network; only the tours are ours, in their favour."""
    task, tables, points = problem.task, problem.tables, problem.task.scene.targets.points

    def evaluate(bits: Bools, genes: Floats) -> tuple[Floats, Floats]:
        objectives, violation = np.full((len(bits), 3), np.inf), np.zeros(len(bits))
        for row in range(len(bits)):
            viewpoints = genes[row][bits[row]]
            tags = problem.visibility.sure_tags(problem.visibility.cell_of(viewpoints))
            few = np.maximum(tables.min_tags - tags.sum(axis=1), 0).sum() / tables.min_tags
            lacking = np.maximum(tables.min_rays - tags.sum(axis=0), 0).sum() + few
            lacking = lacking or loose_by_numpy(tags)
            objectives[row, 2] = len(viewpoints)
            if lacking > 0:
                violation[row] = 1.0 + lacking
                continue
            visible, directions = np.repeat(tags, 4, axis=1), sphere_directions(viewpoints)
            variance = mean_variance_by_numpy(task.sphere.radius * directions, points, visible)
            objectives[row, 0] = variance * tables.variance
            chords = np.linalg.norm(directions[:, None] - directions, axis=2)
            objectives[row, 1] = task.sphere.radius * nearest_neighbour_3opt(chords)[1]
        return objectives, violation

    return evaluate


def loose_by_numpy(tags: Bools) -> int:
    """Return how many of the images, tags (k, g), hang together with the first by no chain of common tags."""
    reached, joined = tags[0], np.zeros(len(tags), np.bool_)
    while True:
        before, joined = joined, (tags & reached).any(axis=1)
        if (joined == before).all():
            return int((~joined).sum())
        reached = tags[joined].any(axis=0)


def agreement(problem: Problem) -> None:
    """Compare the two evaluations on random networks.

    Raises:
        AssertionError: they differ.
    """
    bits, genes = problem.random(np.random.default_rng(0), 100)
    ours, violation = problem.evaluate(bits, genes)
    theirs, lacking = by_numpy(problem)(bits, genes)
    np.testing.assert_allclose(violation, lacking, rtol=1e-9)
    good = violation <= 0
    if good.sum() < 10:
        raise AssertionError("expected feasible networks among random ones")
    np.testing.assert_allclose(ours[good], theirs[good], rtol=1e-9)


def pymoo_seconds(problem: Problem, evaluate: Evaluate, generations: int, seed: int) -> float:
    """CPU seconds of pymoo's NSGA-II, SBX and polynomial mutation."""
    algorithm = NSGA2(
        pop_size=POPULATION, sampling=FloatRandomSampling(), crossover=SBX(prob=0.9, eta=15), mutation=PM(eta=20)
    )
    start = time.process_time()
    minimize(Wrapped(problem, evaluate), algorithm, ("n_gen", generations), seed=seed, verbose=False)
    return time.process_time() - start


def our_seconds(problem: Problem, generations: int, seed: int) -> float:
    """CPU seconds of our plain engine."""
    start = time.process_time()
    run(problem, "nsga2", POPULATION, generations, seed)
    return time.process_time() - start


def rows(long: bool) -> Iterator[Row]:
    """Yield the rows; ``long``: five seeds instead of three."""
    problem = box_problem()
    numpy_evaluation = by_numpy(problem)
    agreement(problem)
    our_seconds(problem, 3, 0)
    pymoo_seconds(problem, problem.evaluate, 3, 0)
    ratios, whole = [], []
    for seed in range(1, 6 if long else 4):
        fast = our_seconds(problem, GENERATIONS, seed)
        ratios.append(pymoo_seconds(problem, problem.evaluate, GENERATIONS, seed) / fast)
        slow = pymoo_seconds(problem, numpy_evaluation, SLICE, seed)
        whole.append(slow / our_seconds(problem, SLICE, seed))
    yield Row(f"NSGA-II {POPULATION} x {GENERATIONS} against pymoo, same operators and kernel", 4.0, ratios)
    yield Row(f"NSGA-II against pymoo with numpy evaluation, {POPULATION} x {SLICE} of both", 40.0, whole)
