"""The verb ``design``: from a study file to the Pareto front of camera networks, RUN/design.json.

Read the study, build the search problem, search, finish the front with exact values, write it. The search can be
interrupted at any moment and resumed to the same bytes.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numba

from netdesign.files.design_json import read_networks, read_unmet, write_design
from netdesign.files.study import load_task, resolve
from netdesign.model.figures import significant
from netdesign.model.progress import Progress, silent
from netdesign.model.results import Design
from netdesign.model.task import Task
from netdesign.placement.finish import finish
from netdesign.placement.free_problem import problem_of
from netdesign.placement.network_problem import NetworkProblem
from netdesign.run_folder import run_folder, start_run
from netdesign.search.engine import run as search
from netdesign.search.state import State, discard
from netdesign.search.state import load as load_state
from netdesign.search.state import save as save_state

CHECKPOINT = "checkpoint.npz"
SECONDS_BETWEEN_CHECKPOINTS = 3.0


@dataclass(frozen=True, kw_only=True)
class DesignOutcome:
    """Where the front is, what to print, and why no network keeps the study's requirements (None: one does)."""

    run: Path
    summary: str
    unmet: str | None


def design_study(
    study: Path, output: Path | None, *, seed: int | None, resume: bool, threads: int, progress: Progress = silent
) -> DesignOutcome:
    """Search the Pareto front of a study and write RUN/design.json.

    Args:
        output: run directory, None for runs/<name>.  seed: instead of the study's.
        resume: go on from RUN/checkpoint.npz; the result is the one of an uninterrupted search.
        threads: of the kernels; the result does not depend on it.

    Raises:
        InputError: the study is wrong, or the run directory holds another one.
        InfeasibleError: no admissible network; the message names the binding constraint with counts.
    """
    task = load_task(study, seed)
    resolved = resolve(study, seed)
    run = run_folder(resolved, output)
    if resume and (run / "design.json").is_file() and not (run / CHECKPOINT).is_file():
        count = len(read_networks(run))
        summary = f"{run}/design.json: {count} networks, finished before"
        return DesignOutcome(run=run, summary=summary, unmet=read_unmet(run))
    numba.set_num_threads(max(1, min(threads, numba.config.NUMBA_NUM_THREADS)))
    problem = problem_of(task, progress)
    start_run(resolved, run)  # nothing is written before the study has turned out to be feasible
    state = _searched(task, problem, run / CHECKPOINT, resume, progress)
    design = finish(problem, state, progress)
    write_design(run / "design.json", task, design)
    discard(run / CHECKPOINT)
    summary = _summary(task, run, design, int(state.evaluations[-1]))
    return DesignOutcome(run=run, summary=summary, unmet=design.answer_reason if design.answer is None else None)


def _searched(task: Task, problem: NetworkProblem, checkpoint: Path, resume: bool, progress: Progress) -> State:
    """Return the finished state of the search; every few seconds, and when interrupted, it is kept on disk."""
    settings = task.study.search
    budget = settings.population * settings.generations
    latest = load_state(checkpoint, task.sha256) if resume and checkpoint.is_file() else None
    start, last_saved = latest, time.monotonic()

    def on_step(state: State) -> None:
        nonlocal latest, last_saved
        latest = state
        done = min(state.spent, budget)
        progress("search", done, budget, f"hypervolume {state.hypervolume[-1]:.4f}")
        if time.monotonic() - last_saved > SECONDS_BETWEEN_CHECKPOINTS:
            save_state(checkpoint, state, task.sha256)
            last_saved = time.monotonic()

    try:
        return search(
            problem, settings.engine, settings.population, settings.generations, task.study.seed,
            resume=start, on_step=on_step,
        )  # fmt: skip
    except KeyboardInterrupt:
        if latest is not None:
            save_state(checkpoint, latest, task.sha256)
        raise


def _summary(task: Task, run: Path, design: Design, evaluations: int) -> str:
    """Return what the front holds, a line for each number of images."""
    unit, scale = {"workspace": ("mm", 1e3), "joint": ("rad", 1.0), "time": ("s", 1.0)}[task.study.motion]
    lines = [f"{run}/design.json: {len(design.networks)} networks after {evaluations} evaluations"]
    for size in sorted({network.f3 for network in design.networks}):
        layer = [network for network in design.networks if network.f3 == size]
        sigma = [1e6 * network.precision.mean_variance**0.5 for network in layer]
        tour = [scale * network.f2 for network in layer]
        lines.append(
            f"  {size:2d} images: 1 network, rms sigma {significant(sigma[0])} um, tour {significant(tour[0])} {unit}"
            if len(layer) == 1
            else f"  {size:2d} images: {len(layer)} networks, rms sigma {significant(min(sigma))} to"
            f" {significant(max(sigma))} um, "
            f"tour {significant(min(tour))} to {significant(max(tour))} {unit}"
        )
    lines += design.notes
    if design.answer is not None:
        network = design.networks[design.answer]
        lines.append(
            f"requirements: network {design.answer:04d} is the cheapest that meets them, {network.f3} images,"
            f" tour {significant(scale * network.f2)} {unit}: {design.answer_reason}"
        )
    return "\n".join(lines)
