"""Repair: what an image is worth against numpy, what is added against brute force, and every format of stations."""

import numpy as np
import pytest

from netdesign.errors import InputError
from netdesign.files.colmap import ColmapModel, write_model
from netdesign.files.robot_program import stations_csv
from netdesign.files.stations import parse_stations, stations_table
from netdesign.model.frames import exp_rotation, look_at, viewpoints_of
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.total_error import total_covariance
from netdesign.photogrammetry.visibility import sightings
from netdesign.placement.repair import Standing
from netdesign.repair import repair_study
from tests.runs import STUDY, ring_run, write_inputs
from tests.scenes import CAMERA, box_scene, plate_scene, ring
from tests.test_placement import task_of


def crooked(count, seed=0):
    """Stations on no sphere, each looking somewhere near the part with a roll of its own."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(count, 3)) * [0.25, 0.25, 0.05] + [0, 0, 0.55]
    return look_at(places, rng.normal(size=(count, 3)) * 0.01, rng.uniform(-3, 3, count))


def f1(task, poses):
    visible = sightings(task.scene, CAMERA, poses, task.limits).visible
    covariance = limited_covariance(poses, task.scene.targets.points, CAMERA.intrinsics, visible, 0.1)
    return np.trace(covariance, axis1=1, axis2=2).mean() / 3


def test_every_drop_is_the_network_without_that_image():
    task = task_of(plate_scene())
    poses = crooked(6)
    standing = Standing(task)
    now = standing.quality(poses)
    assert now.f1 == pytest.approx(f1(task, poses), rel=1e-9)
    visible = sightings(task.scene, CAMERA, poses, task.limits).visible
    total = total_covariance(poses, task.scene.targets.points, CAMERA.intrinsics, visible, 0.1)
    assert now.total_rms == pytest.approx(np.sqrt(total.precision.mean_variance), rel=1e-9)
    assert now.rays == visible.sum(axis=0).min()
    for image, without in enumerate(standing.drops(poses)):
        rest = np.delete(poses, image, axis=0)
        assert without.f1 == pytest.approx(f1(task, rest), rel=1e-9)
        assert without.f1 >= now.f1
        assert without.images == 5


def test_the_added_station_is_as_good_as_any_of_thousands():
    task = task_of(plate_scene())
    standing = Standing(task)
    poses = crooked(3)
    added = standing.addition(poses)
    assert added.quality.f1 == pytest.approx(f1(task, np.concatenate([poses, added.world_from_cam[None]])), rel=1e-9)
    np.testing.assert_allclose(np.linalg.norm(added.world_from_cam[:3, 3]), 0.6)
    rng = np.random.default_rng(1)
    anywhere = task.sphere.cameras(standing.space.uniform(rng, (1500,)))
    best = min(f1(task, np.concatenate([poses, pose[None]])) for pose in anywhere)
    assert added.quality.f1 <= best * 1.001


def test_missing_rays_come_before_precision():
    task = task_of(box_scene(spacing=0.07), max_images=16, min_rays=3)
    standing = Standing(task)
    poses = ring(5, 60.0)[:4]

    def missing(poses):
        rays = sightings(task.scene, CAMERA, poses, task.limits).visible.sum(axis=0)
        return np.maximum(3 - rays, 0).sum()

    left = missing(poses)
    while left:
        found = standing.addition(poses)
        poses = np.concatenate([poses, found.world_from_cam[None]])
        before, left = left, missing(poses)
        assert left < before
        assert (found.quality.short == 0) == (left == 0)
    assert standing.quality(poses).rays >= 3
    assert len(poses) <= 12


def colmap_images(folder, poses):
    points = np.zeros((1, 3))
    write_model(
        folder,
        ColmapModel(
            cameras=(CAMERA,), camera_ids=(1,), camera_of_image=np.zeros(len(poses), int),
            names=tuple(f"{index:02d}.png" for index in range(len(poses))), world_from_cam=poses, point_ids=(1,),
            points=points, image=np.zeros(0, int), point=np.zeros(0, int), xy_px=np.zeros((0, 2)),
        ),
    )  # fmt: skip
    return folder / "images.txt"


def test_stations_are_the_same_from_every_format(tmp_path):
    poses = crooked(5)
    poses[:, :3, :3] = poses[:, :3, :3] @ exp_rotation(np.array([0.1, 0.2, 0.3]))
    (tmp_path / "a.csv").write_text(stations_csv(viewpoints_of(poses[:, :3, 3]), poses, None, ()))
    images = colmap_images(tmp_path / "model", poses)
    for name in (tmp_path / "a.csv", images):
        np.testing.assert_allclose(parse_stations(stations_table(str(name), tmp_path), name), poses, atol=1e-12)
    ring_run(tmp_path / "run")
    of_run = parse_stations(stations_table("run#2", tmp_path), tmp_path)
    direct = parse_stations(stations_table("run/design.json#2", tmp_path), tmp_path)
    np.testing.assert_array_equal(of_run, direct)
    np.testing.assert_allclose(np.linalg.norm(of_run[:, :3, 3], axis=1), 0.6)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_stations_of_a_spreadsheet(tmp_path, end):
    lines = ["\ufeffx_mm;y_mm;z_mm;qx;qy;qz;qw;name", "# measured", "1;2;600;1;0;0;0;top", "0;0;500;1;0;0;0;low", ""]
    (tmp_path / "a.csv").write_bytes(end.join(lines).encode())
    poses = parse_stations(stations_table("a.csv", tmp_path), tmp_path / "a.csv")
    np.testing.assert_allclose(poses[:, :3, 3], [[0.001, 0.002, 0.6], [0, 0, 0.5]], atol=1e-15)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.csv", "x_mm,y_mm\n1,2\n", "found no z_mm"),
        ("a.csv", "x_mm,y_mm,z_mm,qx,qy,qz,qw\n", "at least one station"),
        ("a.csv", "x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,b,0,0,0,1\n", "a.csv:2: z_mm: expected a finite number, found 'b'"),
        ("a.csv", "x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,3,0,0,0,0\n", "unit quaternion"),
        ("images.txt", "1 1 0 0 0 1 2\n\n", "IMAGE_ID, qw"),
        ("images.txt", "# nothing\n", "at least one image"),
        ("a.json", "[]", "found no JSON object"),
        ("a.stl", "solid", "ends with '.stl'"),
    ],
)
def test_wrong_stations_are_one_line(tmp_path, name, content, says):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=says):
        stations_table(name, tmp_path)


def test_a_network_must_exist(tmp_path):
    ring_run(tmp_path / "run")
    for name in ("run", "run#999"):
        with pytest.raises(InputError, match="#0 to #"):
            stations_table(name, tmp_path)
    with pytest.raises(InputError, match="no such file"):
        stations_table("nowhere.csv", tmp_path)


def test_the_command_says_what_it_did_and_writes_what_it_reads(tmp_path):
    study = {**STUDY, "visibility": {"max_incidence_deg": 75, "min_rays": 3}}
    write_inputs(tmp_path / "run", box_scene(spacing=0.06), study)
    poses = ring(8, 40.0)
    (tmp_path / "eight.csv").write_text(stations_csv(viewpoints_of(poses[:, :3, 3]), poses, None, ()))
    out = tmp_path / "more.csv"
    found = repair_study(tmp_path / "run/study.toml", str(tmp_path / "eight.csv"), 2, out)
    assert len(found.record["drop"]) == 8
    assert [item["images"] for item in found.record["add"]] == [9, 10]
    sigmas = [found.record["now"]["rms_sigma_um"], *(item["rms_sigma_um"] for item in found.record["add"])]
    assert sigmas == sorted(sigmas, reverse=True)
    again = repair_study(tmp_path / "run/study.toml", str(out), 0)
    assert again.record["now"]["rms_sigma_um"] == pytest.approx(sigmas[-1], rel=1e-9)
    assert "without image" in found.text
    with pytest.raises(InputError, match="--stations"):
        repair_study(tmp_path / "run/study.toml", None, 1)


def test_an_added_station_of_a_shell_has_its_distance(tmp_path):
    centre = [15.0, -10.0, 5.0]
    viewpoints = {**STUDY["viewpoints"], "centre_mm": centre, "radius_mm": [500, 700], "azimuth_deg": [0, 360]}
    write_inputs(tmp_path / "run", box_scene(spacing=0.06), {**STUDY, "viewpoints": viewpoints})
    poses = crooked(5)
    (tmp_path / "five.csv").write_text(stations_csv(viewpoints_of(poses[:, :3, 3]), poses, None, ()))
    found = repair_study(tmp_path / "run/study.toml", str(tmp_path / "five.csv"), 1, tmp_path / "more.csv")
    (added,) = found.record["add"]
    offset = np.array(added["world_from_cam_mm"])[:3, 3] - centre
    assert added["radius_mm"] == pytest.approx(np.linalg.norm(offset), rel=1e-9)
    assert 500 - 1e-6 <= added["radius_mm"] <= 700 + 1e-6
    assert f", {added['radius_mm']:.0f} mm " in found.text
    # Alpha and beta are about the sphere's centre, also of stations that look elsewhere.
    rows = np.genfromtxt(tmp_path / "more.csv", delimiter=",", names=True)
    offsets = np.stack([rows["x_mm"], rows["y_mm"], rows["z_mm"]], axis=1) - centre
    alpha, beta = np.radians(rows["alpha_deg"]), np.radians(rows["beta_deg"])
    directions = np.stack([np.cos(beta) * np.cos(alpha), np.cos(beta) * np.sin(alpha), np.sin(beta)], axis=1)
    np.testing.assert_allclose(offsets / np.linalg.norm(offsets, axis=1)[:, None], directions, atol=1e-9)
    assert (rows["alpha_deg"] >= 0).all()
