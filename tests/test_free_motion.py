"""Stations beyond the sphere with a robot: planned as on the sphere, search and plan agree, existing stations stay."""

from dataclasses import replace

import numpy as np
import pytest

from netdesign.errors import InfeasibleError
from netdesign.model.frames import look_at
from netdesign.model.stations import Depth
from netdesign.motion.joint_map import JointMap
from netdesign.motion.options import search_options
from netdesign.motion.plan import plan_on
from netdesign.placement.finish import finish
from netdesign.placement.free_problem import FreeProblem, problem_of
from netdesign.placement.known_stations import KnownStations
from netdesign.search.engine import run
from tests.cells import arm, cell, joint_map, reachable_viewpoints
from tests.scenes import plate_scene, sphere
from tests.test_placement import task_of

SHELL = Depth(shape="ellipsoid", low=np.full(3, 0.5), high=np.full(3, 0.7))


def moving_task(depth=SHELL, roll=0.0, motion="joint", existing=None, **tables):
    task = task_of(plate_scene(side=3), **tables)
    objectives = task.study.objectives.model_copy(update={"motion": motion})
    stations = replace(task.sphere, depth=depth, radius=0.7 if depth else 0.6, roll=roll)
    return replace(
        task, cell=cell(), study=task.study.model_copy(update={"objectives": objectives}), sphere=stations,
        existing=np.zeros((0, 4, 4)) if existing is None else existing,
    )  # fmt: skip


@pytest.mark.parametrize("roll", [0.0, None])
@pytest.mark.parametrize("motion", ["joint", "time"])
def test_a_shell_without_width_is_planned_as_the_sphere(roll, motion):
    of_sphere = joint_map("side", roll)
    drawn = reachable_viewpoints(of_sphere, 7, 3)
    thin = Depth(shape="ellipsoid", low=np.full(3, 0.6), high=np.full(3, 0.6))
    of_shell = JointMap.of_arm(arm(), replace(sphere(roll=roll), depth=thin))
    one = plan_on(of_sphere, drawn, motion)
    two = plan_on(of_shell, np.column_stack([drawn, np.full(len(drawn), 0.5)]), motion)
    assert two.tour.length == pytest.approx(one.tour.length, rel=1e-9)
    # An open tour may be driven from either end, and all of it with a joint turned as a whole.
    change = [two.tour.joints - joints for joints in (one.tour.joints, one.tour.joints[::-1])]
    assert min(np.abs(d - 2 * np.pi * np.rint(d / (2 * np.pi))).max() for d in change) < 1e-9


@pytest.mark.parametrize(("roll", "motion"), [(0.0, "joint"), (None, "time")])
def test_a_front_beyond_the_sphere_can_be_driven(roll, motion):
    task = moving_task(roll=roll, motion=motion, max_images=6)
    problem = problem_of(task)
    assert isinstance(problem, FreeProblem)
    state = run(problem, "memetic", 12, 12, 1)
    again = run(problem_of(task), "memetic", 12, 12, 1)
    assert state.archive.members.genes.tobytes() == again.archive.members.genes.tobytes()
    members = state.archive.members
    design = finish(problem, state)
    assert len(design.networks) > 1
    here = problem.joint_map.arm
    for network in design.networks:
        assert (network.radius > 0.5 - 1e-9).all()
        assert (network.radius < 0.7 + 1e-9).all()
        joints = network.tour.joints
        assert (joints >= here.placed.lower).all()
        assert (joints <= here.placed.upper).all()
        assert not any(here.meshes.contact(q) for q in joints)
        if motion == "joint" and not network.warnings:
            assert network.f2 == pytest.approx(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum(), rel=1e-9)
    ratios = []
    for row in range(0, len(members), 3):
        planned = plan_on(problem.joint_map, members.genes[row][members.bits[row]], motion)
        if planned.tour is not None and not planned.warnings:
            ratios.append(planned.tour.length / members.objectives[row, 1])
    assert 0.8 < np.median(ratios) < 1.2


def test_existing_stations_off_the_sphere_are_driven_to():
    place = np.array([[-0.25, 0.1, 0.5], [-0.2, -0.15, 0.55]])
    existing = look_at(place, np.array([0.01, 0.0, 0.0]), np.array([0.2, -0.1]))
    task = moving_task(depth=None, existing=existing, max_images=7)
    problem = problem_of(task)
    assert isinstance(problem, FreeProblem)
    design = finish(problem, run(problem, "memetic", 12, 12, 1))
    for network in design.networks:
        apart = np.abs(network.world_from_cam[:, None] - existing).max(axis=(2, 3))
        assert (apart.min(axis=0) < 1e-9).all()


def test_existing_stations_out_of_reach_are_named():
    far = look_at(np.array([[-0.2, 0.1, 0.5], [3.0, 0.0, 0.5]]), np.zeros(3))
    with pytest.raises(InfeasibleError, match=r"1 of 2 existing stations: station 2 \(out of reach\)"):
        problem_of(moving_task(existing=far, max_images=7))


def test_the_map_of_shells_says_what_the_exact_solution_says():
    stations = replace(sphere(roll=0.0), depth=SHELL, radius=0.7)
    of_shell = JointMap.of_arm(arm(), stations)
    viewpoints = of_shell.lattice(600)
    free = np.array([len(q) > 0 for q in search_options(of_shell, viewpoints)])
    told = np.array([reason == "free" for reason in of_shell.reasons(viewpoints)])
    assert (told & ~free).mean() < 0.005
    assert (free & ~told).mean() < 0.05


def test_a_station_at_the_centre_itself_has_a_tour():
    known = KnownStations.build(moving_task(depth=SHELL))
    network = known.of(known.task.sphere.sample(np.radians(15.0))[0])
    network = [station for station in network if len(station.joints)][:6]
    centre = known.task.sphere.centre
    lengths = [
        known.tour([*network[:2], replace(network[2], place=place), *network[3:]])[0]
        for place in (centre, centre + [1e-9, 0, 0])
    ]
    assert lengths[0] == lengths[1] > 0.0
