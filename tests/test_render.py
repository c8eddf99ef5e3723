"""pyrender and the reference renderer: two implementations that share nothing but the scene and the blur."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from netdesign.errors import InputError
from netdesign.imaging.fit import fit_tag
from netdesign.imaging.geometry import distorted_vertices, divided, monotonic_radius, tag_quads
from netdesign.imaging.optics import expose
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.imaging.render import Renderer, probe
from netdesign.imaging.tags import cells, texture
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.model.scene import Scene
from netdesign.photogrammetry.collinearity import distort, project
from tests.scenes import CAMERA, box_part, box_scene, plate_scene

SMALL = replace(
    CAMERA, width_px=800, height_px=600, focal_px=np.array([1200.0, 1200.0]),
    principal_point_px=np.array([399.5, 299.5]),
)  # fmt: skip
WIDE = replace(SMALL, distortion=np.array([-0.15, 0.05, 0.001, -0.002]))


def poses(count, distance, seed=0):
    random = np.random.default_rng(seed)
    viewpoints = np.column_stack([random.uniform(-np.pi, np.pi, count), random.uniform(0.9, 1.4, count)])
    return look_at(distance * sphere_directions(viewpoints), np.zeros(3), random.uniform(-np.pi, np.pi, count))


def clean_errors(renderer, scene, camera, views, steepest_deg):
    """Return corner errors (k, 4, 2) px of pictures without noise, tags up to the given incidence."""
    errors = []
    for pose in views:
        picture = expose(renderer.render(inverse(pose)), camera, None, 16)
        for quad in tag_quads(scene.targets, camera, inverse(pose)):
            truth = project(pose, scene.targets.points.reshape(-1, 4, 3)[quad.tag], camera.intrinsics)[0]
            inside = (truth > 12).all() and (truth < (camera.width_px - 12, camera.height_px - 12)).all()
            if inside and quad.incidence_cos > np.cos(np.radians(steepest_deg)):
                pattern = cells("tag36h11", int(scene.targets.ids[quad.tag]))
                fit = fit_tag(picture, pattern, truth + 0.2, camera.intrinsics, 65535 / 1500, 1e6)
                assert fit.converged
                errors.append(fit.corners_px - truth)
    return np.array(errors)


@pytest.mark.parametrize("camera", [SMALL, WIDE])
def test_pyrender_draws_corners_where_they_belong(camera):
    scene = plate_scene(side=3, spacing=0.05, tag_size=0.03)
    errors = clean_errors(Renderer(scene, camera, 4), scene, camera, poses(2, 0.45), 45)
    assert len(errors) > 8
    assert np.sqrt((errors**2).mean()) < 0.003
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.0005


def test_tags_square_to_the_pixel_grid_are_drawn_where_they_belong():
    scene = plate_scene(side=3, spacing=0.05, tag_size=0.03)
    upright = look_at(np.array([[0.0, -0.12, 0.43], [0.0, -0.25, 0.36]]), np.zeros(3), 0.0)
    for renderer in (Renderer(scene, SMALL, 4), ReferenceRenderer(scene, SMALL)):
        errors = clean_errors(renderer, scene, SMALL, upright, 45)
        assert len(errors) > 8
        assert np.sqrt((errors**2).mean()) < 0.002  # textures with mip maps: 0.005
        assert np.abs(errors.mean(axis=(0, 1))).max() < 0.0005


@pytest.mark.parametrize("camera", [SMALL, WIDE])
def test_the_reference_renderer_is_exact(camera):
    scene = plate_scene(side=3, spacing=0.05, tag_size=0.03)
    errors = clean_errors(ReferenceRenderer(scene, camera), scene, camera, poses(2, 0.45), 65)
    assert np.sqrt((errors**2).mean()) < 0.001


def test_both_renderers_make_the_same_picture():
    scene = box_scene()
    difference = 255 * np.abs(
        Renderer(scene, WIDE, 4).render(inverse(poses(1, 0.5)[0]))
        - ReferenceRenderer(scene, WIDE).render(inverse(poses(1, 0.5)[0]))
    )
    assert np.median(difference) < 0.5
    assert np.quantile(difference, 0.99) < 4  # silhouettes and far corners


def test_the_part_hides_what_is_behind_it():
    plate = plate_scene(side=1, tag_size=0.03)
    lid = box_part((0.3, 0.3, 0.01), (0, 0, 0.1))
    vertices = np.concatenate([plate.part.vertices, lid.vertices])
    faces = np.concatenate([plate.part.faces, lid.faces + len(plate.part.vertices)])
    covered = Scene(part=replace(plate.part, vertices=vertices, faces=faces), targets=plate.targets)
    pose = look_at(np.array([0.02, 0.01, 0.4]), np.zeros(3), 0.3)
    for renderer in (Renderer(covered, SMALL, 2), ReferenceRenderer(covered, SMALL)):
        picture = renderer.render(inverse(pose))
        assert picture[200:400, 300:500].std() < 0.02  # only the lid


def test_the_picture_does_not_depend_on_what_was_drawn_before_or_on_bands(monkeypatch):
    scene = box_scene()
    renderer = Renderer(scene, WIDE, 2)
    pose, other = poses(2, 0.5)
    first = renderer.render(inverse(pose))
    renderer.render(inverse(other))
    np.testing.assert_array_equal(renderer.render(inverse(pose)), first)
    monkeypatch.setattr("netdesign.imaging.render.BAND_SAMPLES", 800 * 4 * 150)
    np.testing.assert_allclose(renderer.render(inverse(pose)), first, atol=2 / 255)


def test_probe_names_the_renderer():
    assert "OpenGL" in probe()


def test_distorted_vertices_project_like_the_lens_and_never_fold_back():
    points = np.random.default_rng(2).normal(size=(50, 3)) * (0.2, 0.15, 0.02) + (0, 0, 0.8)
    bent = distorted_vertices(points, WIDE.distortion)
    np.testing.assert_allclose(
        bent[:, :2] / bent[:, 2:], distort(points[:, :2] / points[:, 2:], WIDE.distortion), atol=1e-12
    )
    barrel = np.array([-0.2, 0.0, 0.0, 0.0])
    assert monotonic_radius(barrel) == pytest.approx(np.sqrt(1 / 0.6))
    rays = np.column_stack([np.linspace(0, 5, 100), np.zeros(100), np.ones(100)])
    assert (np.diff(distorted_vertices(rays, barrel)[:, 0]) >= -1e-12).all()


def test_division_keeps_the_surface():
    part = box_part()
    triangles, face = divided(part, 0.03)
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    whole = np.linalg.norm(
        np.cross(part.triangles[:, 1] - part.triangles[:, 0], part.triangles[:, 2] - part.triangles[:, 0]), axis=1
    )
    np.testing.assert_allclose(np.bincount(face, area), whole, rtol=1e-9)
    assert np.linalg.norm(np.roll(triangles, 1, axis=1) - triangles, axis=2).max() <= 0.03


def test_tags():
    pattern = cells("tag36h11", 0)
    assert pattern[0].sum() == pattern[-1].sum() == pattern[:, 0].sum() == pattern[:, -1].sum() == 0
    image = texture("tag36h11", 0, 1, 0.1, 0.9)
    assert image.shape == (12, 12)
    assert (image[:2] == 230).all()
    np.testing.assert_array_equal(image[2:10, 2:10] == 230, pattern)
    with pytest.raises(InputError, match="587"):
        cells("tag36h11", 587)
    with pytest.raises(InputError, match="tag36h11"):
        cells("tag99", 0)


WITHOUT_EGL = """
import ctypes, ctypes.util
real_find, real_load = ctypes.util.find_library, ctypes.CDLL.__init__
ctypes.util.find_library = lambda name: None if "EGL" in name else real_find(name)
def load(self, name, *args, **kwargs):
    if name and "EGL" in str(name):
        raise OSError(f"{name}: cannot open shared object file")
    real_load(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = load
import numpy as np
from netdesign.errors import EnvironmentProblem
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.imaging.render import probe
from tests.test_render import SMALL, plate_scene, poses
try:
    probe()
except EnvironmentProblem as problem:
    print(problem)
picture = Photographer(plate_scene(side=1), SMALL, Shoot(renderer="reference")).take(0, poses(1, 0.4)[0])
print(picture.shape)
"""


def test_without_egl_the_packages_are_named_and_the_reference_renderer_works():
    done = subprocess.run([sys.executable, "-c", WITHOUT_EGL], capture_output=True, text=True, check=True)
    message, shape = done.stdout.strip().splitlines()
    assert "libegl1 libgl1" in message
    assert shape == "(600, 800)"
