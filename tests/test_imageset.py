"""Image sets: their truth, their COLMAP model, their determinism; recipes; the noise calibration on a small grid."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from netdesign.dataset import render_dataset
from netdesign.errors import InputError
from netdesign.files.calibrators import kalibr_grid
from netdesign.files.colmap import read_model, write_model
from netdesign.files.noise import read_corner_noise
from netdesign.files.recipe import load_recipe
from netdesign.files.store import read_json
from netdesign.imageset import measure_images, observations_of, render_images, worker_pool
from netdesign.imaging.looks import Appearance
from netdesign.imaging.optics import Shading
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.imaging.pictures import png_bytes, read_picture
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.model.frames import inverse
from netdesign.photogrammetry.collinearity import project
from tests.scenes import CAMERA, LIMITS, box_scene, plate_scene, ring

CAM = replace(
    CAMERA, width_px=640, height_px=520, focal_px=np.array([850.0, 850.0]),
    principal_point_px=np.array([319.5, 259.5]), distortion=np.array([-0.1, 0.03, 0.0, 0.001]),
)  # fmt: skip
EASY = replace(LIMITS, min_tag_px=18)
SCENE = box_scene(tag_size=0.03)
POSES = ring(3, 45, 0.5, 0.2)
RECIPES = sorted((Path(__file__).parents[1] / "datasets" / "imagesets").glob("*.toml"))


@pytest.fixture(scope="module")
def image_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set")
    render_images(SCENE, CAM, EASY, POSES, folder, Shoot(seed=5, supersample=2))
    return folder


def reprojection_error_px(model):
    """As COLMAP computes it from its own camera model; the stored errors (0 in a model we write) say nothing."""
    model.update_point_3d_errors()
    return model.compute_mean_reprojection_error()


def test_the_truth_is_the_projection_of_what_is_seen(image_set):
    truth = read_json(image_set / "truth.json", "truth")
    assert [image["name"] for image in truth["images"]] == ["0000.png", "0001.png", "0002.png"]
    row = {name: index for index, name in enumerate(SCENE.targets.point_ids)}
    for image, pose in zip(truth["images"], POSES, strict=True):
        placed = np.array(image["world_from_cam_mm"])
        placed[:3, 3] /= 1000
        np.testing.assert_allclose(placed, pose, atol=1e-12)
        points = SCENE.targets.points[[row[name] for name in image["points"]]]
        assert len(points) >= 20
        np.testing.assert_allclose(image["xy_px"], project(pose, points, CAM.intrinsics)[0], atol=1e-9)


def test_colmap_opens_the_set_and_finds_no_residual(image_set):
    model = pycolmap.Reconstruction(str(image_set))
    assert model.num_reg_images() == 3
    assert reprojection_error_px(model) < 1e-6
    point = next(iter(model.points3D.values()))
    point.xyz = point.xyz + 1
    assert reprojection_error_px(model) > 1e-3  # a point moved by 1 mm is seen


def test_all_visible_tags_are_measured_where_the_truth_says(image_set):
    paths = sorted((image_set / "images").glob("*.png"))
    observations, covariances, rejected = observations_of(measure_images(paths, CAM, SCENE.targets), SCENE.targets)
    truth = read_json(image_set / "truth.json", "truth")
    expected = sum(len(image["points"]) for image in truth["images"])
    assert len(observations) == 4 * len(covariances)
    assert len(observations) + 4 * len(rejected) >= expected
    exact = project(POSES[observations.image], SCENE.targets.points[observations.point], CAM.intrinsics)[0]
    residual = observations.xy_px - exact
    statistic = np.einsum("ki,kij,kj->k", residual, np.linalg.inv(observations.covariance), residual)
    # Mean of chi2(2) over about 100 tags whose corners share errors: 2 up to some 10 %.
    assert statistic.mean() == pytest.approx(2.0, rel=0.4)
    assert np.abs(residual).max() < 0.15


@pytest.mark.slow
def test_pictures_are_the_same_whatever_the_workers_and_are_not_made_twice(image_set, tmp_path):
    with worker_pool(2) as executor:
        paths = render_images(SCENE, CAM, EASY, POSES, tmp_path, Shoot(seed=5, supersample=2), executor=executor)
    for path in paths:
        assert path.read_bytes() == (image_set / "images" / path.name).read_bytes()
    paths[1].write_bytes(b"kept")
    render_images(SCENE, CAM, EASY, POSES, tmp_path, Shoot(seed=5, supersample=2))
    assert paths[1].read_bytes() == b"kept"
    render_images(SCENE, CAM, EASY, POSES, tmp_path, Shoot(seed=6, supersample=2))
    assert paths[1].read_bytes() != b"kept"


@pytest.mark.parametrize(
    "change",
    [
        {"motion_m": (0.0, 1e-3, 0.0)}, {"lens_samples": 8}, {"glare": 1}, {"shading": Shading(vignetting=4.0)},
        {"appearance": Appearance(face=0.5)}, {"noise": False}, {"renderer": "pyrender"}, {"bits": 16},
        {"camera": replace(CAM, f_number=4.0)}, {"camera": replace(CAM, focus_m=0.5)},
        {"camera": replace(CAM, read_noise_e=9.0)}, {"drawn": "other ids"}, {"scene": "other part"},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_pictures_of_other_settings_are_made_again(tmp_path, monkeypatch, change):
    made = []

    def note(job):
        made.append(job[1])
        job[3].write_bytes(b"picture")

    monkeypatch.setattr("netdesign.imageset._render_one", note)
    camera = replace(CAM, pixel_m=8e-6, f_number=8.0, focus_m=0.6)
    scene, shoot, drawn = SCENE, Shoot(renderer="reference"), None
    for _ in range(2):
        render_images(scene, camera, EASY, POSES[:2], tmp_path, shoot)
    assert made == [0, 1]
    if "drawn" in change:
        ids = scene.targets.ids.copy()
        ids[[0, 1]] = ids[[1, 0]]
        drawn = [scene, replace(scene, targets=replace(scene.targets, ids=ids))]
    elif "scene" in change:  # a shape behind the same tags
        part = replace(scene.part, vertices=scene.part.vertices * np.array([1.0, 1.0, 1.1]))
        scene = replace(scene, part=part)
    elif "camera" in change:
        camera = replace(change["camera"], **({} if change["camera"].pixel_m else {"pixel_m": 8e-6}))
    else:
        shoot = replace(shoot, **change)
    for _ in range(2):
        render_images(scene, camera, EASY, POSES[:2], tmp_path, shoot, drawn=drawn)
    assert made == [0, 1, 0, 1]


def test_the_reference_renderer_makes_the_set_too(tmp_path):
    paths = render_images(SCENE, CAM, EASY, POSES[:1], tmp_path, Shoot(renderer="reference"))
    assert len(measure_images(paths, CAM, SCENE.targets)[0]) > 10


def test_sixteen_bit_pictures_survive_the_file(tmp_path):
    picture = np.random.default_rng(1).integers(0, 65535, (20, 30), dtype=np.uint16)
    (tmp_path / "a.png").write_bytes(png_bytes(picture))
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), picture)
    (tmp_path / "b.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="8 or 16 bit"):
        read_picture(tmp_path / "b.png")
    with pytest.raises(InputError, match="no such image"):
        read_picture(tmp_path / "c.png")


def test_depth_of_field_blurs_by_distance_and_moves_nothing():
    plate = plate_scene(side=1, tag_size=0.03)
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = 0.4
    sharp = replace(CAM, pixel_m=8e-6, f_number=1.4, focus_m=0.4)  # a blur disk of 3.4 px at 0.3 m
    shoot = Shoot(renderer="reference", lens_samples=24)
    at_focus = Photographer(plate, sharp, shoot).light(pose)
    pinhole = Photographer(plate, sharp, Shoot(renderer="reference")).light(pose)
    np.testing.assert_allclose(at_focus, pinhole, atol=0.02)
    beyond = Photographer(plate, replace(sharp, focus_m=0.3), shoot).light(pose)
    assert np.abs(np.diff(beyond, axis=1)).max() < 0.8 * np.abs(np.diff(pinhole, axis=1)).max()
    columns = np.arange(CAM.width_px)
    dark = [np.clip(0.7 - picture[200:320, 260:380], 0, 1) for picture in (beyond, pinhole)]
    centres = [(item.sum(axis=0) * columns[260:380]).sum() / item.sum() for item in dark]
    assert centres[0] == pytest.approx(centres[1], abs=0.1)


def test_masks_and_depth():
    depth, tags = ReferenceRenderer(SCENE, CAM).depth_and_tags(inverse(POSES[0]))
    xy_px, distance = project(POSES[0], SCENE.targets.centres, CAM.intrinsics)
    facing = np.einsum("ij,ij->i", POSES[0][:3, 3] - SCENE.targets.centres, SCENE.targets.normals) > 0.2
    for tag in np.flatnonzero(facing):
        x, y = np.rint(xy_px[tag]).astype(int)
        if 0 <= x < CAM.width_px and 0 <= y < CAM.height_px:
            assert tags[y, x] == tag + 1
            assert depth[y, x] == pytest.approx(distance[tag], rel=0.01)
    assert (depth[tags > 0] > 0).all()


def test_a_recipe_becomes_an_image_set(tmp_path):
    study = (RECIPES[0].parents[1] / "studies" / "plate.toml").resolve()
    recipe = tmp_path / "r.toml"
    text = f'format = 1\nname = "r"\nstudy = "{study}"\ncamera.width_px = 400\ncamera.height_px = 300\n'
    recipe.write_text(
        text + "camera.focal_px = [600, 600]\ncamera.principal_point_px = [199.5, 149.5]\nposes.images = 1\n"
        "exposure.supersample = 2\nfaults.wrong_ids = 1\nfaults.clutter = 2\nfaults.glare = 1\n"
        "extras.depth = true\nextras.tag_mask = true\nextras.kalibr = true\nextras.opencv = true\n"
    )
    (tmp_path / "full.toml").write_text(recipe.read_text())
    assert render_dataset(recipe, tmp_path / "out").images == 1
    for name in ("README.txt", "targets.csv", "camchain.yaml", "aprilgrid.yaml", "camera-opencv.yaml",
                 "depth/0000.npy", "masks/0000.png", "images/0000.png", "truth.json"):  # fmt: skip
        assert (tmp_path / "out" / name).is_file()
    guide = (tmp_path / "out" / "README.txt").read_text()
    there = {path.name for path in (tmp_path / "out").iterdir()} - {"README.txt"}
    assert {name for name in there if name in guide} == there
    recipe.write_text(text + "camera.focal_px = [600, 600]\ncamera.principal_point_px = [199.5, 149.5]\n"
                      "poses.images = 1\nexposure.supersample = 2\n")  # fmt: skip
    render_dataset(recipe, tmp_path / "bare")
    guide = (tmp_path / "bare" / "README.txt").read_text()
    assert not [name for name in ("depth", "masks", "Kalibr", "OpenCV's", "faults") if name in guide]
    recipe.write_text((tmp_path / "full.toml").read_text())
    plan = load_recipe(recipe)
    assert (plan.drawn[0].targets.ids[:25] != plan.scene.targets.ids).sum() == 2
    recipe.write_text(text + "poses.imagse = 1\n")
    with pytest.raises(InputError, match="images"):
        load_recipe(recipe)


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_shipped_recipes_are_readable(path):
    plan = load_recipe(path)
    assert plan.recipe.name == path.stem
    assert len(plan.world_from_cam) >= 4


def test_kalibr_grid_only_for_a_flat_grid():
    assert "tagCols: 5" in kalibr_grid(plate_scene().targets)
    assert kalibr_grid(SCENE.targets) is None


def test_the_shipped_noise_model_was_measured():
    noise = read_corner_noise(None, "tag36h11")
    assert 2.5 < noise.k < 4.0
    assert 0.0003 < noise.floor_px < 0.004


def test_colmap_triangulates_and_adjusts_the_measured_corners(image_set, tmp_path):
    paths = sorted((image_set / "images").glob("*.png"))
    observations, _, _ = observations_of(measure_images(paths, CAM, SCENE.targets), SCENE.targets)
    truth = read_model(image_set)
    rays = np.bincount(observations.point, minlength=len(truth.points))
    seen = np.flatnonzero(rays >= 2)
    usable = observations.select(rays[observations.point] >= 2)
    measured = replace(
        truth, point_ids=tuple(truth.point_ids[j] for j in seen), points=truth.points[seen], image=usable.image,
        point=np.searchsorted(seen, usable.point), xy_px=usable.xy_px,
    )  # fmt: skip
    write_model(tmp_path, measured)
    model = pycolmap.Reconstruction(str(tmp_path))
    for point_id, point in model.points3D.items():
        rows = [(e.image_id, model.images[e.image_id].points2D[e.point2D_idx].xy) for e in point.track.elements]
        placed = pycolmap.estimate_triangulation(
            np.array([xy for _, xy in rows]), [model.images[i].cam_from_world() for i, _ in rows],
            [model.cameras[model.images[i].camera_id] for i, _ in rows],
        )  # fmt: skip
        assert placed is not None
        exact = truth.points[truth.point_ids.index(point_id)] * 1000
        # 0.5 m away at 850 px: 0.02 px are 0.012 mm across and some times that in depth.
        assert np.linalg.norm(placed["xyz"] - exact) < 0.3
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    assert 1e-3 < reprojection_error_px(model) < 0.03  # measured corners: small, never nothing


def test_pictures_of_others_are_not_removed_and_a_file_is_no_folder(tmp_path):
    mine = tmp_path / "images" / "mine.png"
    mine.parent.mkdir()
    mine.write_bytes(b"mine")
    with pytest.raises(InputError, match="without truth"):
        render_images(SCENE, CAM, EASY, POSES[:1], tmp_path, Shoot(renderer="reference"))
    assert mine.read_bytes() == b"mine"
    with pytest.raises(InputError, match="can be written"):
        render_images(SCENE, CAM, EASY, POSES[:1], mine, Shoot(renderer="reference"))


@pytest.mark.parametrize("line", ["poses.distance_mm = [700, 400]", "poses.distance_mm = [-9, 4]", "light.white = 3"])
def test_recipes_with_impossible_values_are_refused(tmp_path, line):
    study = (RECIPES[0].parents[1] / "studies" / "plate.toml").resolve()
    recipe = tmp_path / "r.toml"
    recipe.write_text(f'format = 1\nname = "r"\nstudy = "{study}"\n{line}\n')
    with pytest.raises(InputError, match="expected"):
        load_recipe(recipe)
