"""A data set as its reader uses it: `adjust` measures the photographs and must reach the truth within its sigma."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from netdesign.adjust import adjust_folder
from netdesign.adjustment.nominal import misplaced_tags
from netdesign.dataset import render_dataset
from netdesign.errors import InputError
from netdesign.files.store import read_json
from netdesign.imaging.plausible import enclosed, fold_radius_px
from netdesign.model.frames import pose, similarity, transform
from tests.scenes import CAMERA, box_part, box_scene

STUDY = Path(__file__).parents[1] / "datasets" / "studies" / "plate.toml"


@pytest.fixture(scope="module")
def faulty_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faulty")
    (folder / "r.toml").write_text(
        f'format = 1\nname = "r"\nstudy = "{STUDY.resolve()}"\nposes.images = 8\nexposure.supersample = 2\n'
        "camera.width_px = 1000\ncamera.height_px = 800\ncamera.focal_px = [1500, 1500]\n"
        "camera.principal_point_px = [499.5, 399.5]\nfaults.wrong_ids = 2\n"
    )
    render_dataset(folder / "r.toml", folder / "set")
    return folder / "set"


def _normalised_errors(folder, record):
    truth = {point["id"]: point["xyz_mm"] for point in read_json(folder / "truth.json", "truth")["points"]}
    estimates = [point for point in record["points"] if point["xyz_mm"] is not None]
    true = np.array([truth[point["id"]] for point in estimates])
    found = np.array([point["xyz_mm"] for point in estimates])
    scale, rotation, shift = similarity(found, true)
    errors = scale * found @ rotation.T + shift - true
    return errors / np.array([point["sigma_inner_mm"] for point in estimates])


def test_adjust_finds_exchanged_ids_and_reaches_the_truth_within_its_sigma(faulty_set, tmp_path):
    outcome = adjust_folder(faulty_set, robust=True, out=tmp_path)
    normalised = _normalised_errors(faulty_set, json.loads(outcome.path.read_text()))
    assert len(normalised) == 100
    # 300 errors of sigma 1, correlated: their rms is known to some 10 %; an id not found is an error of hundreds.
    assert 0.6 < np.sqrt(np.mean(normalised**2)) < 1.4
    assert np.abs(normalised).max() < 5
    assert not any("targets.csv" in warning for warning in outcome.adjustment.warnings)


def test_exchanged_places_in_targets_csv_are_named(faulty_set, tmp_path):
    rows = list(csv.reader((faulty_set / "targets.csv").read_text().splitlines()))
    by_tag = {row[0]: row for row in rows[1:]}
    by_tag["3"][1:], by_tag["20"][1:] = by_tag["20"][1:], by_tag["3"][1:]
    for name in ("camera.toml", "images"):
        (tmp_path / name).symlink_to(faulty_set / name)
    (tmp_path / "targets.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    warnings = adjust_folder(tmp_path, robust=True).adjustment.warnings
    (line,) = [warning for warning in warnings if "targets.csv" in warning]
    assert re.findall(r"(\d+) \(", line) == ["3", "20"]


@pytest.mark.parametrize("wrong", [(), (2, 7), (2, 7, 11, 12, 0)])
def test_misplaced_tags_are_those_that_moved(wrong):
    nominal = box_scene().targets.points
    rng = np.random.default_rng(4)
    points = nominal + rng.normal(scale=3e-4, size=nominal.shape)
    for first, second in zip(wrong, np.roll(wrong, 1), strict=True):
        points[4 * first : 4 * first + 4] = nominal[4 * second : 4 * second + 4]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = 1.3 * transform(pose(turn * np.sign(np.linalg.det(turn)), np.array([1.0, 2, 3])), points)
    used = np.ones(len(points), bool)
    used[4 * 5] = False
    deviation, misplaced = misplaced_tags(points, nominal, used)
    np.testing.assert_array_equal(np.flatnonzero(misplaced), sorted(wrong))
    assert np.isnan(deviation[5])
    assert not misplaced_tags(points[:12], nominal[:12], used[:12])[1].any()  # too few to say


def test_pictures_too_wide_for_opengl_are_refused_before_anything_is_written(tmp_path):
    (tmp_path / "r.toml").write_text(
        f'format = 1\nname = "r"\nstudy = "{STUDY.resolve()}"\nposes.images = 1\ncamera.width_px = 19000\n'
    )
    with pytest.raises(InputError, match="lower supersample or use --renderer reference"):
        render_dataset(tmp_path / "r.toml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


IMPOSSIBLE = {
    "fold": ("camera.distortion = [-3.0, 0, 0, 0]", "does not fold"),
    "inside": ("poses.given = [[0, 0, -1.5, 0, 0, 0]]", "outside the part, found inside it: 0000.png"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_what_no_camera_can_photograph_is_refused(case, tmp_path):
    line, message = IMPOSSIBLE[case]
    (tmp_path / "r.toml").write_text(f'format = 1\nname = "r"\nstudy = "{STUDY.resolve()}"\n{line}\n')
    with pytest.raises(InputError, match=message):
        render_dataset(tmp_path / "r.toml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_images_that_show_no_tag_are_named(tmp_path):
    (tmp_path / "r.toml").write_text(
        f'format = 1\nname = "r"\nstudy = "{STUDY.resolve()}"\ncamera.width_px = 400\ncamera.height_px = 300\n'
        "camera.principal_point_px = [199.5, 149.5]\ncamera.focal_px = [600, 600]\nexposure.supersample = 1\n"
        "poses.given = [[0, 0, 500, 0, 0, 0], [0, 0, 500, 180, 0, 0]]\n"  # away from the plate, towards it
    )
    made = render_dataset(tmp_path / "r.toml", tmp_path / "out")
    assert made.blind == ("0000.png",)
    assert made.text.endswith("1 of 2 image(s) show no tag within the study's [visibility]: 0000.png")


def test_the_fold_is_where_the_distorted_radius_turns_back():
    radii = np.linspace(0, 2, 200001)
    for k1, k2 in ((-3.0, 0.0), (-0.5, 0.02), (-0.4, -0.1)):
        bent = radii * (1 + k1 * radii**2 + k2 * radii**4)
        turn = np.flatnonzero(np.diff(bent) < 0)[0]
        camera = replace(CAMERA, distortion=np.array([k1, k2, 0, 0]))
        assert fold_radius_px(camera.intrinsics) == pytest.approx(3600 * bent[turn], rel=1e-6)
    assert fold_radius_px(replace(CAMERA, distortion=np.array([-0.1, 0.03, 0, 0])).intrinsics) == np.inf
    assert fold_radius_px(CAMERA.intrinsics) == np.inf


def test_a_closed_part_encloses_its_inside_only():
    part = box_part(size=(0.2, 0.2, 0.2))
    np.testing.assert_array_equal(enclosed(part, np.array([[0, 0, 0], [0.09, 0.0, 0.05], [0.11, 0, 0]])), [1, 1, 0])
    opened = replace(part, faces=part.faces[2:])
    assert not enclosed(opened, np.zeros((1, 3))).any()
