"""Why a search found no admissible network: what the nearest one lacks, in one line."""

import numpy as np

from netdesign.photogrammetry.connectivity import components, listed, loose_images
from netdesign.placement.decide import round_up
from netdesign.placement.network_problem import NetworkProblem
from netdesign.search.engine import run as search
from netdesign.search.state import State


def why_infeasible(problem: NetworkProblem, state: State) -> str:
    """Return one line that says what the best network of a search without a feasible one still lacks."""
    task, limits, slots = problem.task, problem.task.limits, problem.chromosomes.slots
    cover = problem.cover
    if rare := _rare_tags(problem):
        return rare
    if cover.least > slots:
        return (
            f"viewpoints.max_images: over {cover.candidates} candidate stations at least"
            f" {cover.least + len(task.existing)} images are needed to see every object point {limits.min_rays} times,"
            f" allowed are {slots + len(task.existing)}"
        )
    best = int(np.argmin(state.population.violation))
    viewpoints = state.population.genes[best][state.population.bits[best]]
    sees = problem.sees(viewpoints)
    lacking = sees.sum(axis=0) + problem.existing_sees.sum(axis=0) < limits.min_rays
    parts = []
    if lacking.any():
        parts.append(f"{4 * lacking.sum()} of {4 * len(lacking)} object points have fewer than {limits.min_rays} rays")
    poor = (sees.sum(axis=1) < problem.min_tags).sum()
    if poor:
        least = limits.min_points_per_image
        what = f"fewer than {least} points" if least else "no object point"
        parts.append(f"{poor} of {len(viewpoints)} images see {what}")
    loose = loose_images(np.concatenate([sees, problem.existing_sees]))
    if loose:
        parts.append(f"{loose} of {len(viewpoints)} images share no object point with the others{_groups(problem)}")
    if problem.joint_map is not None:
        refused = (~problem.reachable(viewpoints)).sum()
        if refused:
            parts.append(f"{refused} of {len(viewpoints)} stations are out of the robot's reach")
    if not parts and task.study.requirements.max_tour is not None:
        return f"requirements.max_tour: {_shortest(problem)}"
    if not parts:
        parts.append("some points are seen under nearly parallel rays")
    return f"no admissible network among {state.evaluations[-1]} evaluated; of the nearest one " + ", ".join(parts)


def _groups(problem: NetworkProblem) -> str:
    """Say that no choice of candidate stations ties all tags together; empty when some choice does."""
    sees = np.concatenate([problem.sees(problem.candidates()), problem.existing_sees])
    sizes = np.unique(components(sees)[1], return_counts=True)[1]
    if len(sizes) < 2:
        return ""
    each = listed([str(size) for size in sorted(sizes.tolist(), reverse=True)])
    return f" (no candidate station sees tags of two of the {len(sizes)} groups of {each} tags: studies of their own?)"


def _rare_tags(problem: NetworkProblem) -> str:
    """Say which tags no choice of stations sees often enough: nothing within reach does; empty when there are none."""
    task, limits = problem.task, problem.task.limits
    candidates = problem.candidates()
    seen = problem.sees(candidates).sum(axis=0) + problem.existing_sees.sum(axis=0)
    rare = np.flatnonzero(seen < limits.min_rays)
    if not rare.size:
        return ""
    names = ", ".join(f"{task.scene.targets.ids[g]} (by {seen[g]})" for g in rare[:8]) + ", …" * (rare.size > 8)
    where = "" if problem.joint_map is None else " within the robot's reach"
    return (
        f"{rare.size} of {len(seen)} tags are seen by fewer than {limits.min_rays} of {len(candidates)} candidate"
        f" stations{where}: tags {names}; leave them out, or change what limits the stations"
    )


def _shortest(problem: NetworkProblem) -> str:
    """What the tour takes at least: the same search without the limit."""
    study = problem.task.study
    free = problem.without_tour_limit()
    found = search(free, study.search.engine, study.search.population, study.search.generations, study.seed)
    asked = f"no admissible network with a tour of at most {study.requirements.max_tour:g}"
    objectives = found.archive.members.objectives
    if not len(objectives):
        return f"{asked}, and none with a longer one"
    best = objectives[np.argmin(objectives[:, 1])]
    unit, scale = {"workspace": ("mm", 1e3), "joint": ("rad", 1.0), "time": ("s", 1.0)}[study.motion]
    return (
        f"{asked} {unit}; the shortest one found takes {round_up(scale * best[1]):g} {unit} with {int(best[2])} images"
    )
