"""The shipped parts, cameras, cells and studies: sound meshes, tags with room around them, studies that resolve."""

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh

from netdesign.files.study import load_task, read_study
from netdesign.model.study import CameraTable, RobotTable
from netdesign.photogrammetry.visibility import sightings

DATASETS = Path(__file__).parents[1] / "datasets"
PARTS = ("polyhedron", "plate", "bracket")
STUDIES = sorted((DATASETS / "studies").glob("*.toml"))
STUDY_IDS = [path.stem for path in STUDIES]
BORDER_MM = 12.5  # half of a 20 mm tag and one cell of white


def mesh_of(name):
    return trimesh.load(DATASETS / "parts" / f"{name}.stl", force="mesh")


def tags_of(name):
    """Centres, normals, x axes, y axes (g, 3), in mm."""
    rows = np.loadtxt(DATASETS / "parts" / f"{name}_tags.csv", delimiter=",", skiprows=1)
    return rows[:, 1:4], rows[:, 4:7], rows[:, 7:10], np.cross(rows[:, 4:7], rows[:, 7:10])


@pytest.mark.parametrize("name", PARTS)
def test_parts_are_closed_and_wound_outward(name):
    mesh = mesh_of(name)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert (mesh.extents <= (271, 271, 201)).all()


@pytest.mark.parametrize("name", PARTS)
def test_tag_frames_are_right_handed_and_upright(name):
    _, normals, x_axes, y_axes = tags_of(name)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(x_axes, axis=1), 1.0, atol=1e-7)
    np.testing.assert_allclose((normals * x_axes).sum(axis=1), 0.0, atol=1e-7)
    assert (y_axes[:, 2] >= -1e-9).all()


@pytest.mark.parametrize("name", PARTS)
def test_tags_lie_on_their_face_with_a_white_border(name):
    """Points all over the 25 mm square are on the surface, on a triangle with the tag's normal."""
    mesh = mesh_of(name)
    centres, normals, x_axes, y_axes = tags_of(name)
    steps = np.linspace(-BORDER_MM, BORDER_MM, 7)
    for centre, normal, x_axis, y_axis in zip(centres, normals, x_axes, y_axes, strict=True):
        square = np.array([centre + a * x_axis + b * y_axis for a in steps for b in steps])
        coplanar = (mesh.face_normals @ normal > 1 - 1e-6) & (
            np.abs(mesh.triangles[:, 0] @ normal - centre @ normal) < 1e-3
        )
        triangles = mesh.triangles[coplanar]
        edges = np.roll(triangles, -1, axis=1) - triangles
        inward = np.cross(normal, edges)
        side = np.einsum("pted,ted->pte", square[:, None, None] - triangles, inward)
        assert (side >= -1e-3 * np.linalg.norm(edges, axis=2).max()).all(axis=2).any(axis=1).all(), centre


@pytest.mark.parametrize("name", PARTS)
def test_tags_and_their_borders_do_not_overlap(name):
    centres, normals, x_axes, y_axes = tags_of(name)
    for i in range(len(centres)):
        offset = centres - centres[i]
        same_plane = (normals @ normals[i] > 1 - 1e-6) & (np.abs(offset @ normals[i]) < 0.01)
        apart = np.maximum(np.abs(offset @ x_axes[i]), np.abs(offset @ y_axes[i])) >= 2 * BORDER_MM - 1e-6
        assert (apart | ~same_plane | (np.arange(len(centres)) == i)).all()


def test_the_polyhedron_is_convex_and_every_face_but_the_bottom_carries_tags():
    mesh = mesh_of("polyhedron")
    assert abs(mesh.volume / mesh.convex_hull.volume - 1) < 1e-6
    faces = {tuple(normal) for normal in mesh.facets_normal.round(4)}
    tagged = {tuple(normal) for normal in tags_of("polyhedron")[1].round(4)}
    assert len(faces) == len(mesh.facets) == 12
    assert len(tagged) == 11
    assert 40 <= len(tags_of("polyhedron")[0]) <= 60


def test_the_bracket_is_not_convex_and_hides_its_tags():
    task = load_task(DATASETS / "studies" / "bracket.toml")
    ring = np.stack([np.linspace(-np.pi, np.pi, 72, endpoint=False), np.full(72, np.radians(45.0))], axis=1)
    refusals = sightings(task.scene, task.camera, task.sphere.cameras(ring), task.limits).refusals()
    assert refusals["occluded"] > 0.05 * refusals["seen"]


def test_the_script_makes_the_committed_parts_again(tmp_path):
    script = DATASETS / "parts" / "make_parts.py"
    subprocess.run([sys.executable, str(script), str(tmp_path)], check=True, capture_output=True)
    for name in PARTS:
        np.testing.assert_allclose(trimesh.load(tmp_path / f"{name}.stl").triangles, mesh_of(name).triangles, atol=1e-4)
        made = np.loadtxt(tmp_path / f"{name}_tags.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(
            made, np.loadtxt(DATASETS / "parts" / f"{name}_tags.csv", delimiter=",", skiprows=1), atol=1e-6
        )


@pytest.mark.parametrize("path", STUDIES, ids=STUDY_IDS)
def test_studies_resolve_and_every_tag_can_be_seen(path):
    """From a grid of stations, each tag is seen by many more than a network must have."""
    task = load_task(path)
    assert task.study.name == path.stem
    low, high = task.sphere.elevation
    alpha, beta = np.meshgrid(np.linspace(-np.pi, np.pi, 48, endpoint=False), np.linspace(low, high, 16))
    cameras = task.sphere.cameras(np.stack([alpha.ravel(), beta.ravel()], axis=1))
    seen = sightings(task.scene, task.camera, cameras, task.limits).visible
    assert seen.sum(axis=0).min() >= 5 * task.limits.min_rays
    assert task.scene.targets.ids.tolist() == sorted(set(task.scene.targets.ids.tolist()))


@pytest.mark.parametrize("path", STUDIES, ids=STUDY_IDS)
def test_a_few_stations_suffice(path):
    """A greedy choice covers every tag often enough with at most the images the study allows."""
    task = load_task(path)
    rng = np.random.default_rng(1)
    low, high = task.sphere.elevation
    beta = np.arcsin(rng.uniform(np.sin(low), np.sin(high), 1000))
    viewpoints = np.stack([rng.uniform(*task.sphere.azimuth, 1000), beta], axis=1)
    seen = sightings(task.scene, task.camera, task.sphere.cameras(viewpoints), task.limits).reason == 0
    free, need, images = np.ones(1000, bool), np.full(seen.shape[1], task.limits.min_rays), 0
    while (need > 0).any():
        best = int(np.argmax((seen * (need > 0)).sum(axis=1) * free))
        free[best], images, need = False, images + 1, need - seen[best]
    assert images <= 0.75 * task.sphere.max_images


def test_quick_is_the_same_cell_as_the_full_study():
    full, quick = (read_study(DATASETS / "studies" / f"{name}.toml") for name in ("polyhedron-ur10", "quick"))
    assert quick.robot == full.robot
    assert quick.part == full.part
    assert quick.search.max_networks <= 8


@pytest.mark.parametrize("path", sorted((DATASETS / "cameras").glob("*.toml")), ids=lambda path: path.stem)
def test_cameras_are_valid_tables(path):
    CameraTable.model_validate(tomllib.loads(path.read_text(encoding="utf-8"))["camera"])


@pytest.mark.parametrize("path", sorted((DATASETS / "cells").glob("*.toml")), ids=lambda path: path.stem)
def test_cells_are_valid_tables(path):
    RobotTable.model_validate(tomllib.loads(path.read_text(encoding="utf-8"))["robot"])


def test_every_dataset_is_described():
    text = (DATASETS / "README.md").read_text(encoding="utf-8")
    for folder in ("cameras", "cells", "studies"):
        for path in (DATASETS / folder).glob("*.toml"):
            assert f"`{path.name}`" in text or f"`{path.stem}`" in text, path.name
