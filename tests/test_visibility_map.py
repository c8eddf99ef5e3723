from dataclasses import replace

import numpy as np
import pytest
import trimesh

from netdesign.model.scene import Part, Scene
from netdesign.photogrammetry.bvh import TriangleTree
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.occlusion import cone_is_free, neighbours
from netdesign.photogrammetry.visibility import sight_settings, sightings
from netdesign.placement.visibility_cells import stretches
from netdesign.placement.visibility_map import VisibilityMap, cell_index, field_bounds, spread_angle
from tests.scenes import CAMERA, LIMITS, box_scene, plate_scene, sphere
from tests.test_visibility import bracket_scene

WIDE = replace(
    CAMERA, focal_px=np.array([2600.0, 2500]), distortion=np.array([-0.2, 0.1, 1e-3, -2e-3]), pixel_m=3.45e-6,
    f_number=5.6, focus_m=0.6,
)  # fmt: skip
SHORT = replace(CAMERA, focal_px=np.array([1250.0, 1250.0]), distortion=np.array([-0.25, 0.07, 1e-3, -5e-4]))
COARSE = np.radians(2)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def torus_scene():
    """A ring of 1500 triangles that floats over the plate: a fine mesh with a hole to look through."""
    ring, plate = trimesh.creation.torus(0.1, 0.03, 50, 15), plate_scene()
    part = Part(
        vertices=np.concatenate([plate.part.vertices, ring.vertices + [0, 0, 0.08]]),
        faces=np.concatenate([plate.part.faces, ring.faces + len(plate.part.vertices)]),
    )
    return Scene(part=part, targets=plate.targets)


def everywhere_in_cells(grid_map, rng, count):
    """Random viewpoints, half of them pushed into the corners of their cells, where a proof would fail first."""
    cells = rng.integers(0, len(grid_map.sure), count)
    offset = rng.uniform(-1, 1, (count, 2))
    offset[::2] = np.sign(offset[::2]) * (1 - 1e-9)
    return cells, grid_map.centres[cells] + offset * grid_map.half_steps


CASES = {
    "box": (box_scene(spacing=0.1), CAMERA, sphere(), LIMITS),
    "plate": (plate_scene(), CAMERA, sphere(), LIMITS),
    "bracket": (bracket_scene(), CAMERA, sphere(), LIMITS),
    "torus": (torus_scene(), CAMERA, sphere(radius=0.59), LIMITS),
    "every limit binds": (bracket_scene(), WIDE, sphere(radius=0.5, roll=0.4), replace(LIMITS, min_tag_px=55)),
    "free roll": (bracket_scene(), WIDE, sphere(radius=0.4, roll=None), replace(LIMITS, min_tag_px=60)),
    "short lens, free roll": (bracket_scene(), SHORT, sphere(radius=0.45, roll=None), LIMITS),
    "from below": (box_scene(spacing=0.1), WIDE, sphere(radius=0.35, elevation=(-89, 20)), LIMITS),
    "inside the part's reach": (plate_scene(), CAMERA, sphere(radius=0.16), LIMITS),
}


@pytest.mark.parametrize("name", CASES)
def test_sure_is_seen_from_everywhere_in_the_cell_and_no_bit_from_nowhere(name):
    scene, camera, stations, limits = CASES[name]
    rng = np.random.default_rng(7)
    grid_map = VisibilityMap.build(scene, camera, stations, limits, step=COARSE)
    cells, viewpoints = everywhere_in_cells(grid_map, rng, 4000)
    roll = rng.uniform(-np.pi, np.pi, len(cells)) if stations.roll is None else None
    seen = sightings(scene, camera, stations.cameras(viewpoints, roll), limits).visible_tags
    sure, possible = grid_map.sure_tags(cells), grid_map.possible_tags(cells)
    assert not (sure & ~seen).any()
    assert not (seen & ~possible).any()
    assert not (grid_map.sure & grid_map.maybe).any()


@pytest.mark.parametrize(("name", "most"), [("box", 0.012), ("plate", 0.012), ("bracket", 0.015), ("torus", 0.03)])
def test_at_half_a_degree_little_is_undecided(name, most):
    grid_map = VisibilityMap.build(*CASES[name])
    cells = np.arange(len(grid_map.sure))
    undecided = grid_map.possible_tags(cells) & ~grid_map.sure_tags(cells)
    assert undecided.mean() < most
    assert grid_map.sure_tags(cells).mean() > 10 * undecided.mean()


def test_a_short_lens_with_a_free_roll_sees_tags_for_certain():
    """Its corners bend the image by more than its own size; what is measured with lies far inside of them."""
    scene, camera, stations, limits = CASES["short lens, free roll"]
    grid_map = VisibilityMap.build(scene, camera, stations, limits)
    cells = np.arange(len(grid_map.sure))
    undecided = grid_map.possible_tags(cells) & ~grid_map.sure_tags(cells)
    assert grid_map.sure_tags(cells).mean() > 5 * undecided.mean()


def test_the_stretch_of_a_distortion_bounds_its_edges():
    rng = np.random.default_rng(5)
    for _ in range(300):
        camera = replace(CAMERA, distortion=rng.normal(size=4) * [0.3, 0.2, 5e-3, 5e-3], focal_px=np.ones(2))
        settings, radius = (
            sight_settings(replace(camera, principal_point_px=np.zeros(2)), LIMITS, 0.02),
            rng.uniform(0, 1),
        )
        least, most = stretches(radius, settings)
        ends = rng.normal(size=(60, 2, 2))
        ends *= radius * rng.uniform(0, 1, (60, 2, 1)) / np.linalg.norm(ends, axis=2, keepdims=True)
        flat = np.concatenate([ends, np.ones((60, 2, 1))], axis=2)
        image = project(np.eye(4), flat, settings[:8])[0]
        ratio = np.linalg.norm(image[:, 1] - image[:, 0], axis=1) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        assert (ratio >= least - 1e-9).all()
        assert (ratio <= most + 1e-9).all()


def test_a_finer_map_never_contradicts_a_coarser_one():
    coarse, fine = (VisibilityMap.build(*CASES["bracket"], step=step) for step in (COARSE, COARSE / 2))
    above = coarse.cell_of(fine.centres)
    below = np.arange(len(fine.sure))
    assert not (coarse.sure_tags(above) & ~fine.possible_tags(below)).any()
    assert not (fine.sure_tags(below) & ~coarse.possible_tags(above)).any()


@pytest.mark.parametrize("azimuth", [(-np.pi, np.pi), (0.3, 2.0), (2.5, 4.0)])
def test_cells_partition_the_admissible_range(azimuth):
    stations = replace(sphere(), azimuth=azimuth)
    grid_map = VisibilityMap.build(plate_scene(), CAMERA, stations, LIMITS, step=0.05)
    assert grid_map.rows * grid_map.columns == len(grid_map.sure) == len(grid_map.centres)
    turned = grid_map.centres + [[2 * np.pi, 0]]
    for viewpoints in (grid_map.centres, turned, turned - [[4 * np.pi, 0]]):
        np.testing.assert_array_equal(grid_map.cell_of(viewpoints), np.arange(len(grid_map.sure)))
    assert grid_map.solid_angles.sum() == pytest.approx(1)
    low, high = azimuth
    beta = float(grid_map.centres[0, 1])
    assert cell_index(low - 1e-12, beta, grid_map.grid) in (0, grid_map.columns - 1)
    assert cell_index(high, beta, grid_map.grid) in (0, grid_map.columns - 1)
    if high - low < 3:
        assert cell_index(low - 0.1, beta, grid_map.grid) == 0
        assert cell_index(high + 0.1, beta, grid_map.grid) == grid_map.columns - 1
    assert cell_index(low, 2.0, grid_map.grid) == (grid_map.rows - 1) * grid_map.columns


def test_the_spread_of_a_cell_is_its_largest_angle():
    rng = np.random.default_rng(3)
    for _ in range(200):
        half_alpha, half_beta = rng.uniform(0.001, 0.3, 2)
        beta = rng.uniform(-np.pi / 2 + half_beta, np.pi / 2 - half_beta)
        alpha, tilt = rng.uniform(-half_alpha, half_alpha, 500), beta + rng.uniform(-half_beta, half_beta, 500)
        alpha[:250], tilt[:100] = np.sign(alpha[:250]) * half_alpha, beta + half_beta * np.sign(tilt[:100] - beta)
        cosine = np.sin(beta) * np.sin(tilt) + np.cos(beta) * np.cos(tilt) * np.cos(alpha)
        assert np.arccos(np.clip(cosine, -1, 1)).max() <= spread_angle(beta, half_alpha, half_beta) + 1e-7


def test_the_field_of_a_camera_without_distortion_is_its_inscribed_and_circumscribed_circle():
    inner, outer, _ = field_bounds(CAMERA, LIMITS, True)
    assert inner == pytest.approx((2048 / 2 - 10) / 3600)
    assert outer == pytest.approx(np.hypot(2448 / 2 - 10, 2048 / 2 - 10) / 3600)
    barrel = field_bounds(replace(CAMERA, distortion=np.array([-0.3, 0, 0, 0])), LIMITS, True)
    assert barrel[0] > inner, "a barrel brings more into the frame"


def test_a_free_cone_contains_only_free_rays():
    rng = np.random.default_rng(11)
    tree = TriangleTree.build(rng.uniform(-1, 1, (60, 1, 3)) + 0.1 * rng.normal(size=(60, 3, 3)))
    outcomes = []
    for _ in range(300):
        apex, camera, spread = rng.uniform(-1, 1, 3), 3 * rng.normal(size=3), rng.uniform(0.01, 0.5)
        distance = np.linalg.norm(camera - apex)
        if distance <= spread:
            continue
        down = np.zeros(3)
        free = cone_is_free(
            *apex, (camera - apex) / distance, distance, spread, down, -1.0, tree.bounds, tree.starts, tree.triangles
        )
        offset = rng.normal(size=(200, 3))
        ends = camera + spread * offset / np.linalg.norm(offset, axis=1, keepdims=True)
        blocked = tree.blocked(np.tile(apex, (200, 1)), ends)
        outcomes.append((free, blocked.any()))
        assert not (free and blocked.any())
    free, blocked = np.array(outcomes).T
    assert (free == ~blocked).mean() > 0.95, "and few free cones go unrecognised"


def test_neighbours_share_an_edge_in_opposite_directions():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    tree = TriangleTree.build(mesh.triangles)
    across = neighbours(tree)
    assert (across >= 0).all()
    for row, others in enumerate(across):
        for other in others:
            assert row in across[other]
    assert (neighbours(TriangleTree.build(mesh.triangles[:1])) == -1).all()
    assert neighbours(TriangleTree.build(np.zeros((0, 3, 3)))).shape == (0, 3)


def test_the_cache_gives_the_same_map_survives_damage_and_knows_its_input(tmp_path):
    first = VisibilityMap.build(plate_scene(), CAMERA, sphere(), LIMITS, step=COARSE)
    (stored,) = (tmp_path / "netdesign").iterdir()
    again = VisibilityMap.build(plate_scene(), CAMERA, sphere(), LIMITS, step=COARSE)
    np.testing.assert_array_equal(first.sure, again.sure)
    stored.write_bytes(b"damaged")
    repaired = VisibilityMap.build(plate_scene(), CAMERA, sphere(), LIMITS, step=COARSE)
    np.testing.assert_array_equal(first.maybe, repaired.maybe)
    VisibilityMap.build(plate_scene(), CAMERA, sphere(radius=0.61), LIMITS, step=COARSE)
    assert len(list((tmp_path / "netdesign").iterdir())) == 2


def test_a_cache_that_cannot_be_written_is_no_cache(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert VisibilityMap.build(plate_scene(side=1), CAMERA, sphere(), LIMITS, step=COARSE).sure.any()


def test_more_than_64_tags_take_a_second_word():
    scene = plate_scene(side=9, spacing=0.03)
    grid_map = VisibilityMap.build(scene, CAMERA, sphere(), LIMITS, step=COARSE)
    assert grid_map.words == 2
    assert grid_map.sure_tags(np.array([grid_map.cell_of(np.array([0.0, 1.5]))])).all()
