"""Stations that are not on one sphere, and existing ones: the same numbers as numpy, never outside, always there."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netdesign.errors import InputError
from netdesign.model.camera import CornerNoise
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.stations import Depth
from netdesign.photogrammetry.connectivity import loose_images
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.visibility import Sight, sightings
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.finish import finish
from netdesign.placement.free_problem import FreeProblem, problem_of
from netdesign.placement.problem import Problem
from netdesign.search.engine import run
from tests.scenes import CAMERA, box_scene, plate_scene, sphere
from tests.test_placement import task_of
from tests.test_visibility import bracket_scene

SHELL = Depth(shape="ellipsoid", low=np.full(3, 0.45), high=np.full(3, 0.7))
ELLIPSOID = Depth(shape="ellipsoid", low=np.array([0.7, 0.5, 0.6]), high=np.array([0.7, 0.5, 0.6]))
BETWEEN = Depth(shape="ellipsoid", low=np.array([0.5, 0.45, 0.4]), high=np.array([0.8, 0.6, 0.7]))
BOX = Depth(shape="box", low=np.array([-0.5, -0.4, 0.3]), high=np.array([0.5, 0.4, 0.7]))
SHAPES = {"shell": SHELL, "ellipsoid": ELLIPSOID, "between": BETWEEN, "box": BOX}


def free_task(depth, scene=None, existing=None, **tables):
    task = task_of(plate_scene(side=3) if scene is None else scene, **tables)
    stations = replace(task.sphere, depth=depth, radius=1.0) if depth else task.sphere
    return replace(task, sphere=stations, existing=np.zeros((0, 4, 4)) if existing is None else existing)


def inside(depth, places):
    """Whether places (…, 3) relative to the centre lie in the body, to rounding."""
    if depth.shape == "box":
        return ((places >= depth.low - 1e-9) & (places <= depth.high + 1e-9)).all(axis=-1)
    near, far = np.linalg.norm(places / depth.low, axis=-1), np.linalg.norm(places / depth.high, axis=-1)
    return (near >= 1 - 1e-9) & (far <= 1 + 1e-9)


@pytest.mark.parametrize("name", SHAPES)
@given(seed=st.integers(0, 10**6))
@settings(deadline=None, max_examples=10)
def test_stations_stay_inside_whatever_breeds_them(name, seed):
    space = Chromosomes(sphere=replace(sphere(max_images=6), depth=SHAPES[name], radius=1.0), slots=6)
    rng = np.random.default_rng(seed)
    drawn = space.uniform(rng, (40,))
    for viewpoints in (drawn, space.spread(60), space.nudged(rng, drawn)):
        assert viewpoints.shape[-1] == 3
        assert space.sphere.admissible(viewpoints).all()
        poses = space.sphere.cameras(viewpoints)
        places = poses[:, :3, 3]
        assert inside(SHAPES[name], places).all()
        np.testing.assert_allclose(poses, look_at(places, np.zeros(3)), atol=1e-12)
        back, radius = space.sphere.placed(poses)
        np.testing.assert_allclose(sphere_directions(back) * radius[:, None], places, atol=1e-12)
        elevation = np.degrees(back[:, 1])
        assert ((elevation > 10 - 1e-9) & (elevation < 90 + 1e-9)).all()


def test_a_box_is_entered_and_left_where_a_ray_meets_its_faces():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near, far = BOX.limits(directions)
    steps = np.linspace(0.0, 1.2, 1201)
    within = inside(BOX, steps[:, None, None] * directions)
    assert np.array_equal(within.any(axis=0), (far - near > 2e-3) | within.any(axis=0))
    hit = within.any(axis=0)
    assert np.abs(steps[within.argmax(axis=0)][hit] - near[hit]).max() <= 1.1e-3
    assert np.abs(steps[len(steps) - 1 - within[::-1].argmax(axis=0)][hit] - far[hit]).max() <= 1.1e-3
    assert BOX.limits(np.array([0.0, 0.0, 1.0])) == (pytest.approx(0.3), pytest.approx(0.7))


@pytest.mark.parametrize("name", SHAPES)
def test_evaluation_equals_numpy(name):
    task = free_task(SHAPES[name], scene=bracket_scene(), max_images=14)
    task = replace(task, camera=replace(CAMERA, corner_noise=CornerNoise(k=0.6, floor_px=0.01)))
    check_evaluation(task, FreeProblem.build(task))


def check_evaluation(task, problem):
    rng = np.random.default_rng(3)
    bits, genes = (np.concatenate(pair) for pair in zip(problem.random(rng, 30), problem.seeds(), strict=True))
    objectives, violation = problem.evaluate(bits, genes)
    assert (violation <= 0).sum() >= 3
    for row in range(0, len(bits), 3):
        poses = problem.poses(genes[row][bits[row]])
        visible = sightings(task.scene, task.camera, poses, task.limits).visible
        if violation[row] >= 1:
            rays, points = visible.sum(axis=0), visible[len(task.existing) :].sum(axis=1)
            lacking = (rays < task.limits.min_rays).any() or (points < task.limits.min_points_per_image).any()
            assert lacking or loose_images(visible[:, ::4]) > 0
            continue
        sigma = sighting_sigma(task.camera, poses, task.scene.targets)
        covariance = limited_covariance(poses, task.scene.targets.points, task.camera.intrinsics, visible, sigma)
        assert objectives[row, 0] == pytest.approx(np.trace(covariance, axis1=1, axis2=2).mean() / 3, rel=1e-9)
        assert objectives[row, 2] == len(poses)


def test_both_ways_agree_on_the_sphere():
    """A shell without width is the sphere: station by station gives what the kernels give where all is sure."""
    task = task_of(plate_scene(side=3), max_images=8)
    fast = Problem.build(task)
    shell = Depth(shape="ellipsoid", low=np.full(3, 0.6), high=np.full(3, 0.6))
    slow = FreeProblem.build(replace(task, sphere=replace(task.sphere, depth=shell)))
    bits, genes = fast.seeds()
    one = fast.evaluate(bits, genes)
    two = slow.evaluate(bits, np.concatenate([genes, np.zeros((*genes.shape[:2], 1))], axis=2))
    good = (one[1] <= 0) & (two[1] <= 0)
    assert good.sum() > 5
    np.testing.assert_allclose(one[0][good, 1:], two[0][good, 1:], rtol=1e-9)
    assert (two[0][good, 0] <= one[0][good, 0] * (1 + 1e-9)).all()  # exact rays see at least what is sure
    np.testing.assert_allclose(np.median(one[0][good, 0] / two[0][good, 0]), 1.0, rtol=1e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_a_search_ends_in_an_exact_front(name):
    task = free_task(SHAPES[name], max_images=6)
    problem = problem_of(task)
    assert isinstance(problem, FreeProblem)
    state = run(problem, "memetic", 20, 20, 1)
    again = run(FreeProblem.build(task), "memetic", 20, 20, 1)
    assert state.archive.members.genes.tobytes() == again.archive.members.genes.tobytes()
    design = finish(problem, state)
    assert len(design.networks) > 3
    for network in design.networks:
        assert inside(SHAPES[name], network.world_from_cam[:, :3, 3]).all()
        places = network.radius[:, None] * sphere_directions(network.viewpoints)
        np.testing.assert_allclose(places, network.world_from_cam[:, :3, 3], atol=1e-9)
        assert network.bound_ratio >= 1
    if name == "shell":  # nearer is better over a plate that fits into the frame
        best = min(design.networks, key=lambda network: network.f1)
        assert best.radius.mean() < 0.5


def test_depth_of_field_binds_a_free_radius():
    camera = replace(CAMERA, pixel_m=3.45e-6, f_number=8.0, focus_m=0.6)
    near, far = camera.depth_of_field()
    assert 0.4 < near < 0.6 < far < 1.0
    task = free_task(Depth(shape="ellipsoid", low=np.full(3, 0.3), high=np.full(3, 1.0)), max_images=5)
    task = replace(task, camera=camera)
    design = finish(problem_of(task), run(problem_of(task), "memetic", 20, 20, 1))
    sight = Sight(task.scene, camera, task.limits)
    points = task.scene.targets.points
    for network in design.networks:
        visible = sight.look(network.world_from_cam).visible
        assert (visible.sum(axis=0) >= 2).all()
        rays = points - network.world_from_cam[:, None, :3, 3]
        depth = np.einsum("nmk,nk->nm", rays, network.world_from_cam[:, :3, 2])
        assert near <= depth[visible].min()
        assert depth[visible].max() <= far


def off_sphere(count):
    rng = np.random.default_rng(5)
    places = rng.normal(size=(count, 3)) * [0.2, 0.2, 0.05] + [0, 0, 0.5]
    return look_at(places, rng.normal(size=(count, 3)) * 0.01, rng.uniform(-3, 3, count))


@pytest.mark.parametrize("depth", [None, SHELL])
def test_existing_stations_are_in_every_network(depth):
    existing = off_sphere(3)
    task = free_task(depth, scene=box_scene(spacing=0.09), existing=existing, max_images=12, min_rays=3)
    problem = problem_of(task)
    check_evaluation(task, problem)
    design = finish(problem, run(problem, "memetic", 30, 20, 1))
    for network in design.networks:
        places = network.world_from_cam[:, :3, 3]
        apart = np.linalg.norm(places[:, None] - existing[:, :3, 3], axis=2)
        assert (apart.min(axis=0) < 1e-12).all()
        for pose, row in zip(existing, apart.argmin(axis=0), strict=True):
            np.testing.assert_allclose(network.world_from_cam[row], pose, atol=1e-12)
        assert network.f3 == len(places) > 3
        assert network.precision.rays.min() >= 3
    assert any("3 existing" in note for note in design.notes)


def test_existing_stations_on_the_sphere_take_the_fast_way():
    task = task_of(plate_scene(side=3), max_images=8)
    given = np.array([[0.3, 0.9], [2.5, 0.8]])
    task = replace(task, existing=task.sphere.cameras(given))
    problem = problem_of(task)
    assert type(problem) is Problem
    rng = np.random.default_rng(0)
    bits, genes = problem.random(rng, 50)
    objectives, violation = problem.evaluate(bits, genes)
    free = Problem.build(replace(task, existing=np.zeros((0, 4, 4)), sphere=replace(task.sphere, max_images=10)))
    whole_bits = np.concatenate([np.ones((50, 2), bool), bits], axis=1)
    whole = np.concatenate([np.broadcast_to(problem.pinned, (50, 2, 2)), genes], axis=1)
    np.testing.assert_allclose(problem.pinned, given, atol=1e-12)
    expected, broken = free.evaluate(whole_bits, whole)
    np.testing.assert_allclose(violation, broken)
    np.testing.assert_allclose(objectives[violation <= 0], expected[violation <= 0], rtol=1e-9)
    state = run(problem, "memetic", 30, 30, 1)
    some = state.archive.members.take(np.arange(0, len(state.archive), 9))
    tried = problem.improve(rng, some, rng.random(len(some)))
    again = problem.evaluate(tried.bits, tried.genes)
    good = tried.violation <= 0
    np.testing.assert_allclose(tried.objectives[good, 0], again[0][good, 0], rtol=1e-9)
    for network in finish(problem, state).networks:
        for pose in task.existing:
            assert np.abs(network.world_from_cam - pose).max(axis=(1, 2)).min() < 1e-9
        assert network.bound_ratio >= 1


def test_existing_stations_that_leave_no_room_are_refused():
    task = task_of(plate_scene(side=3), max_images=3)
    with pytest.raises(InputError, match="fewer stations than the 3 images"):
        problem_of(replace(task, existing=off_sphere(3)))


@pytest.mark.parametrize("fast", [True, False])
def test_requirements_with_existing_stations(fast):
    """What the existing stations need beside them: nothing, a few images, or more than are allowed."""
    task = task_of(plate_scene(side=3), max_images=7)
    given = task.sphere.cameras(np.array([[0.3, 0.8], [2.4, 0.8], [-1.8, 0.8]])) if fast else off_sphere(3)
    sizes = []
    for limit in (60.0, 10.0, 5.0):
        asked = task_of(plate_scene(side=3), max_images=7, requirements={"max_sigma_um": limit})
        problem = problem_of(replace(asked, existing=given))
        assert isinstance(problem, Problem) == fast
        design = finish(problem, run(problem, "memetic", 20, 20, 1))
        if design.answer is None:
            assert "with 7 images" in design.answer_reason
            continue
        sizes.append(design.networks[design.answer].f3)
        assert design.networks[design.answer].precision.sigma.max() <= 1e-6 * limit
    assert sizes[0] == 3
    assert 3 < sizes[1] <= 7
    assert len(sizes) == 2


def test_requirements_are_met_beyond_the_sphere():
    task = free_task(SHELL, max_images=8, requirements={"max_sigma_um": 9.0})
    problem = problem_of(task)
    design = finish(problem, run(problem, "memetic", 20, 30, 1))
    answer = design.networks[design.answer]
    assert answer.precision.sigma.max() <= 9.0e-6
    cheaper = [network for network in design.networks if (network.f3, network.f2) < (answer.f3, answer.f2)]
    assert all(network.precision.sigma.max() > 9.0e-6 for network in cheaper)
