from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netdesign.model.camera import CornerNoise
from netdesign.model.frames import look_at
from netdesign.model.scene import Part, Scene, Targets
from netdesign.model.stations import Depth
from netdesign.model.study import Study
from netdesign.model.task import Task
from netdesign.photogrammetry.collinearity import project_with_jacobians
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.precision import corner_sigma, sighting_sigma
from netdesign.photogrammetry.visibility import Sight, sightings
from netdesign.placement.bound import Certificate, lower_bounds
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.information import quadratic_forms
from netdesign.placement.optimal_design import optimal_weights
from netdesign.placement.problem import Problem
from netdesign.placement.sighting_weight import tangent, weight_table
from netdesign.search.engine import run
from tests.scenes import CAMERA, LIMITS, box_scene, plate_scene, sphere
from tests.test_visibility import bracket_scene
from tests.test_visibility_map import WIDE

SHELL = Depth(shape="ellipsoid", low=np.full(3, 0.45), high=np.full(3, 0.7))
ELLIPSOID = Depth(shape="ellipsoid", low=np.array([0.7, 0.5, 0.6]), high=np.array([0.7, 0.5, 0.6]))
BETWEEN = Depth(shape="ellipsoid", low=np.array([0.5, 0.45, 0.4]), high=np.array([0.8, 0.6, 0.7]))
BOX = Depth(shape="box", low=np.array([-0.5, -0.4, 0.3]), high=np.array([0.5, 0.4, 0.7]))
NEAR_BOX = Depth(shape="box", low=np.array([-0.3, -0.3, 0.25]), high=np.array([0.4, 0.4, 0.6]))
DISTORTED = replace(
    CAMERA, focal_px=np.array([3600.0, 3500]), distortion=np.array([0.15, -0.1, 1e-3, -2e-3]),
    corner_noise=CornerNoise(k=1.0, floor_px=0.01),
)  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def make_task(scene, camera=CAMERA, stations=None, limits=LIMITS, **objectives):
    study = Study(
        format=1, name="test", part={"mesh": "none"}, targets={"size_mm": 20, "spacing_mm": 50},
        camera={"width_px": 1, "height_px": 1, "focal_px": (1, 1), "principal_point_px": (0, 0)},
        viewpoints={"radius_mm": 1}, objectives=objectives,
    )  # fmt: skip
    return Task(
        study=study, scene=scene, camera=camera, sphere=stations or sphere(), limits=limits, cell=None, sha256="0" * 64
    )


def mean_variance(task, world_from_cam, sight=None):
    """f1 in m² from exact rays; infinite when a point is undetermined."""
    sight = sight or Sight(task.scene, task.camera, task.limits)
    sigma = sighting_sigma(task.camera, world_from_cam, task.scene.targets)
    covariance = limited_covariance(
        world_from_cam, task.scene.targets.points, task.camera.intrinsics, sight.look(world_from_cam).visible, sigma
    )
    return np.trace(covariance, axis1=1, axis2=2).sum() / (3 * len(covariance))


def improved(task, viewpoints, rng, steps):
    """A network after a random local search: moves of single cameras that lower f1."""
    sight = Sight(task.scene, task.camera, task.limits)
    best = mean_variance(task, task.sphere.cameras(viewpoints), sight)
    for step in range(steps):
        moved = viewpoints.copy()
        size = 0.5 * 0.02 ** (step / steps)
        moved[rng.integers(len(moved))] += size * rng.normal(size=moved.shape[1])
        moved = Chromosomes(sphere=task.sphere, slots=1).folded(moved)
        if not task.sphere.admissible(moved).all():
            continue
        value = mean_variance(task, task.sphere.cameras(moved), sight)
        if value <= best:
            viewpoints, best = moved, value
    return viewpoints, best


def random_viewpoints(rng, stations, count):
    viewpoints = Chromosomes(sphere=stations, slots=1).uniform(rng, (count,))
    if stations.depth is not None:
        viewpoints[::2, 2] = 0.0  # the nearest are the best
    return viewpoints


CASES = {
    "plate": make_task(plate_scene()),
    "bracket": make_task(bracket_scene()),
    "box": make_task(box_scene(spacing=0.1)),
    "wide": make_task(bracket_scene(), WIDE, sphere(radius=0.5, roll=0.3)),
    "distorted": make_task(plate_scene(side=3, spacing=0.08), DISTORTED),
    "free roll": make_task(plate_scene(side=3), DISTORTED, sphere(roll=None)),
    "off centre": make_task(bracket_scene(), stations=replace(sphere(), centre=np.array([0.03, -0.05, 0.02]))),
}


def beyond(task, depth, **content):
    """The task with stations in a body about the centre."""
    return replace(task, sphere=replace(task.sphere, depth=depth, radius=1.0), **content)


BODIES = {
    "range": beyond(CASES["plate"], SHELL),
    "ellipsoid": beyond(CASES["bracket"], BETWEEN),
    "thin ellipsoid": beyond(CASES["box"], ELLIPSOID),
    "box": beyond(CASES["distorted"], BOX),
    "near box": beyond(CASES["wide"], NEAR_BOX),
    "any roll": beyond(CASES["free roll"], SHELL),
}  # fmt: skip
ALL = {**CASES, **BODIES}


@pytest.mark.parametrize("name", ALL)
def test_no_network_beats_the_bound(name):
    task = ALL[name]
    rng = np.random.default_rng(1)
    sizes = (2, 4, 8, 20, 60)
    bounds = lower_bounds(task, sizes)
    assert set(bounds) == set(sizes)
    finite = 0
    for trial in range(40):
        count = sizes[trial % len(sizes)]
        viewpoints = random_viewpoints(rng, task.sphere, count)
        if trial % 2 and task.sphere.depth is None:
            viewpoints[:, 1] = rng.uniform(0.5, 1.0)
        roll = rng.uniform(-np.pi, np.pi, count) if task.sphere.roll is None else None
        f1 = mean_variance(task, task.sphere.cameras(viewpoints, roll))
        assert f1 >= bounds[count]
        finite += np.isfinite(f1)
    assert finite >= (1 if name == "near box" else 4)
    start = random_viewpoints(rng, task.sphere, 8)
    if task.sphere.depth is None:
        start[:, 1] = 0.8
    assert improved(task, start, rng, 100)[1] >= bounds[8]


class Recorded(Problem):
    """A problem that keeps everything it evaluates."""

    def evaluate(self, bits, genes):
        self.__dict__.setdefault("seen", []).extend(row[chosen] for row, chosen in zip(genes, bits, strict=True))
        return super().evaluate(bits, genes)

    def improve(self, rng, members, preference):
        tried = super().improve(rng, members, preference)
        self.__dict__["seen"].extend(row[chosen] for row, chosen in zip(tried.genes, tried.bits, strict=True))
        return tried


@pytest.mark.parametrize("name", ["plate", "box", "distorted", "free roll", "off centre"])
@pytest.mark.parametrize("engine", ["memetic", "nsga2"])
def test_no_network_of_a_search_beats_the_bound(name, engine):
    """Every network that a search evaluates, feasible or not, with exact rays, distortion and the detector's sigma."""
    task = CASES[name]
    task = replace(task, sphere=replace(task.sphere, max_images=12), limits=replace(task.limits, min_rays=2))
    built = Problem.build(task)
    problem = Recorded(**{field.name: getattr(built, field.name) for field in fields(Problem)})
    run(problem, engine, 24, 30, 1)
    networks = [viewpoints for viewpoints in problem.seen if len(viewpoints) >= 2]
    assert len(networks) >= 24 * 30 - 100
    bounds = lower_bounds(task, range(2, 13))
    sight = Sight(task.scene, task.camera, task.limits)
    ratios = [
        mean_variance(task, task.sphere.cameras(viewpoints), sight) / bounds[len(viewpoints)]
        for viewpoints in networks[:: 2 if engine == "memetic" else 5]
    ]
    assert min(ratios) >= 1
    if name == "plate" and engine == "memetic":
        assert min(ratios) < 1.01  # the bound is near enough to be beaten if it were wrong


@pytest.mark.parametrize("name", ALL)
@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=4)
def test_no_station_of_a_cell_gives_more_than_the_cell_s_bound(name, seed):
    """The heart of the proof, for any symmetric Z: exact Jacobians and rays of stations against their cells."""
    task, rng = ALL[name], np.random.default_rng(seed)
    certificate = Certificate(task)
    for _ in range(5):
        cells = certificate.cells
        chosen = rng.random(len(cells)) < 0.5
        parts = certificate.space.parts(cells.take(chosen), rng.integers(0, 3, int(chosen.sum())))
        certificate.cells = cells.take(~chosen).joined(parts)
    cells = certificate.cells
    points = task.scene.targets.points
    square_root = rng.normal(size=(len(points), 3, 3)) * rng.uniform(0.1, 1, (len(points), 1, 1))
    multipliers = square_root + np.swapaxes(square_root, 1, 2)
    bounds = certificate._largest(cells, quadratic_forms(multipliers @ multipliers, certificate.points))[:, 0]

    viewpoints = random_viewpoints(rng, task.sphere, 200)
    roll = rng.uniform(-np.pi, np.pi, 200) if task.sphere.roll is None else None
    poses = task.sphere.cameras(viewpoints, roll)
    seen = sightings(task.scene, task.camera, poses, task.limits).visible
    sigma = sighting_sigma(task.camera, poses, task.scene.targets)
    jacobian = project_with_jacobians(poses[:, None], points[None], task.camera.intrinsics).d_xy_d_point
    exact = np.einsum("nm,nmij->n", seen / sigma**2, np.einsum("nmik,mkj->nmij", jacobian, multipliers) ** 2)
    placed, radius = task.sphere.placed(poses)
    stations = np.column_stack([viewpoints[:, 0], placed[:, 1], radius])
    inside = (np.abs(stations[:, None] - cells.middle) <= cells.half + 1e-9).all(axis=2)
    assert inside[seen.any(axis=1)].any(axis=1).all()  # no admissible station that sees anything is lost
    ceiling = np.where(inside, bounds, np.inf).min(axis=1, initial=np.inf)
    assert (exact <= ceiling * (1 + 1e-9)).all()
    assert (exact[np.isfinite(ceiling)] > 0.1 * ceiling[np.isfinite(ceiling)]).any()


def test_over_the_plate_the_bound_is_sharp():
    """Issue 3: at most 1.10 for the best networks of at least 8 images."""
    task = CASES["plate"]
    bounds = lower_bounds(task, range(3, 17))
    for count in (3, 8, 11, 16):
        azimuth = 2 * np.pi * np.arange(count) / count
        ratios = [
            mean_variance(task, task.sphere.cameras(np.stack([azimuth, np.full(count, elevation)], axis=1)))
            / bounds[count]
            for elevation in np.radians(np.arange(25, 45, 0.5))
        ]
        assert 1 <= min(ratios) <= (1.01 if count >= 8 else 1.03)


def test_a_single_small_tag_reaches_the_closed_form():
    """1.5 sigma² S² / k (notes, reference case 1): tight frames exist when rays up to 89 degrees are admitted."""
    targets = Targets(ids=[0], centres=[[0, 0, 0]], normals=[[0, 0, 1]], x_axes=[[1, 0, 0]], size_m=1e-3)
    part = Part(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3)))
    limits = replace(LIMITS, max_incidence=np.radians(89), min_tag_px=0)
    task = make_task(Scene(part=part, targets=targets), limits=limits, stations=sphere(elevation=(1, 90)))
    found = lower_bounds(task, [1, 6])
    closed = 1.5 * CAMERA.sigma_px**2 * (0.6 / 3600) ** 2
    assert 0.99 * closed <= found[1] <= 1.0001 * closed
    assert found[6] == pytest.approx(found[1] / 6)
    azimuth = 2 * np.pi * np.arange(3) / 3
    frame = np.stack([azimuth, np.full(3, np.pi / 2 - np.arccos(1 / np.sqrt(3)))], axis=1)
    assert mean_variance(task, task.sphere.cameras(frame)) == pytest.approx(closed / 3, rel=1e-4)


def test_a_range_without_width_is_the_sphere_and_more_stations_never_raise_the_bound():
    task = CASES["bracket"]
    on_sphere = lower_bounds(task, [8])[8]
    shells = [Depth(shape="ellipsoid", low=np.full(3, low), high=np.full(3, 0.6)) for low in (0.6, 0.5, 0.4)]
    same, wider, widest = (lower_bounds(beyond(task, shell), [8])[8] for shell in shells)
    assert same == pytest.approx(on_sphere, rel=0.01)
    assert 0.4 * on_sphere < widest < 0.9 * wider < 0.8 * same


def test_over_the_plate_the_bound_is_sharp_for_a_range_of_distances():
    task = beyond(CASES["plate"], Depth(shape="ellipsoid", low=np.full(3, 0.5), high=np.full(3, 0.7)))
    bound = lower_bounds(task, [8])[8]
    azimuth = 2 * np.pi * np.arange(8) / 8
    ratios = [
        mean_variance(task, task.sphere.cameras(np.column_stack([azimuth, np.full(8, elevation), np.zeros(8)]))) / bound
        for elevation in np.radians(np.arange(25, 45, 1))
    ]
    assert 1 <= min(ratios) <= 1.02


def test_fewer_sightings_raise_the_bound():
    task = CASES["bracket"]
    strict = replace(task, limits=replace(LIMITS, max_incidence=np.radians(50)))
    assert lower_bounds(strict, [1])[1] > 1.02 * lower_bounds(task, [1])[1]


@pytest.mark.parametrize("name", ["plate", "range", "box", "off centre"])
def test_existing_stations_count_by_what_they_see(name):
    """Weak ones, far off the body, raise the bound of every size; no network that contains them lies below it."""
    task, rng = ALL[name], np.random.default_rng(3)
    places = rng.normal(size=(4, 3)) * 0.1 + [0.0, 0.0, 1.4]
    existing = look_at(task.sphere.centre + places, task.sphere.centre, rng.uniform(-3, 3, 4))
    pinned = replace(task, existing=existing)
    sizes = [6, 8, 15]
    bounds, without = lower_bounds(pinned, [3, *sizes]), lower_bounds(task, sizes)
    assert set(bounds) == set(sizes)
    assert all(bounds[size] > 1.05 * without[size] for size in sizes)
    finite, ratios = 0, []
    for trial in range(60):
        count = sizes[trial % len(sizes)]
        viewpoints = random_viewpoints(rng, task.sphere, count - 4)
        f1 = mean_variance(pinned, np.concatenate([existing, task.sphere.cameras(viewpoints)]))
        finite += np.isfinite(f1)
        ratios.append(f1 / bounds[count])
    assert min(ratios) >= 1
    assert finite >= 10


def test_of_the_existing_stations_alone_the_bound_is_f1():
    task = CASES["plate"]
    poses = task.sphere.cameras(np.array([[0.0, 0.7], [2.0, 0.7], [4.0, 0.8]]))
    found = lower_bounds(replace(task, existing=poses), [3, 4])
    assert found[3] == pytest.approx(mean_variance(task, poses), rel=1e-5)
    assert found[3] <= mean_variance(task, poses)
    assert found[4] < found[3]


def test_nothing_is_claimed_where_nothing_is_proved():
    plate = plate_scene(side=2)
    assert lower_bounds(make_task(plate, precision="max_sigma"), [8]) == {}
    assert lower_bounds(make_task(plate, propagation="total"), [8]) == {}
    assert lower_bounds(make_task(plate, stations=sphere(elevation=(-80, -40))), [8]) == {}


@pytest.mark.parametrize("seed", range(3))
def test_a_point_that_one_candidate_sees_does_not_break_the_optimum(seed):
    """As with an arm of short reach: a point without depth must not turn a height negative by rounding."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(200, 12, 3))
    directions[:, 0] = [0.3, -0.2, 0.9] + 1e-5 * rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    matrices = 1e8 * (np.eye(3) - directions[..., :, None] * directions[..., None, :])
    matrices[1:, 0] = 0.0
    flat = matrices[:, :, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].reshape(200, -1)
    _, weights = optimal_weights(flat, np.full(200, 1 / 200))
    assert np.isfinite(weights).all()
    assert (weights >= 0).all()
    assert weights.sum() == pytest.approx(1.0)


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_tangent_of_the_weight_lies_above_it_all_over_a_cell(seed):
    rng = np.random.default_rng(seed)
    camera = replace(
        CAMERA, corner_noise=CornerNoise(k=float(rng.uniform(0.5, 5)), floor_px=float(rng.uniform(0, 0.02)))
    )
    size, incidence = 0.02, np.radians(65)
    table = weight_table(camera, size, (0.3, 1.0), incidence)
    turned, ratio = float(np.exp(rng.uniform(-8, -1.5))), float(np.exp(rng.uniform(-8, -1.5)))
    cosine = float(rng.uniform(np.cos(incidence), 1.0))
    depth = float(rng.uniform(0.3 * np.exp(ratio), 1.0))
    found = tangent(depth, depth * np.exp(-ratio), cosine, turned, 0.0, 0.0, table)
    value, by_cosine, by_depth, rest = found
    away = rng.uniform(-1.0, 1.0, (400, 2)) * [turned, ratio]
    away[:4] = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * [turned, ratio]
    place = np.column_stack([cosine + away[:, 0], depth * np.exp(away[:, 1])])
    there = (place[:, 0] <= 1.0) & (place[:, 0] >= np.cos(incidence)) & (place[:, 1] <= 1.0)
    if by_cosine == by_depth == 0.0:  # the largest value, at the nearest depth and the steepest view
        there &= away[:, 1] >= -ratio
    edge = float(np.sqrt(camera.focal_px.prod())) * size / place[:, 1]
    weight = camera.focal_px.max() ** 2 / corner_sigma(camera, edge, np.arccos(np.minimum(place[:, 0], 1.0))) ** 2
    above = value + by_cosine * away[:, 0] + by_depth * away[:, 1] + rest
    assert (weight[there] <= above[there] * (1.0 + 1e-9)).all()
