from dataclasses import replace

import numpy as np
import pytest

from netdesign.imaging.detect import detect
from netdesign.imaging.measure import Gates, measure
from netdesign.imaging.optics import expose, noise_generator
from netdesign.imaging.pictures import linear
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.model.scene import Part
from netdesign.photogrammetry.collinearity import project
from tests.scenes import CAMERA, plate_scene

CAM = replace(
    CAMERA, width_px=500, height_px=420, focal_px=np.array([1000.0, 1000.0]),
    principal_point_px=np.array([249.5, 209.5]),
)  # fmt: skip
SCENE = plate_scene(side=3, spacing=0.04, tag_size=0.02)
POSE = look_at(0.45 * sphere_directions(np.radians([20.0, 65.0])), np.zeros(3), 0.4)
TRUTH = project(POSE, SCENE.targets.points, CAM.intrinsics)[0].reshape(-1, 4, 2)


@pytest.fixture(scope="module")
def picture():
    return expose(ReferenceRenderer(SCENE, CAM).render(inverse(POSE)), CAM, noise_generator(1, 0))


def test_every_tag_is_found_and_good(picture):
    found = measure(picture, CAM, "tag36h11", 0.02)
    assert [tag.tag_id for tag in found] == list(range(9))
    assert {tag.rejected for tag in found} == {""}
    errors = np.array([tag.corners_px for tag in found]) - TRUTH
    assert np.sqrt((errors**2).mean()) < 0.015
    np.testing.assert_allclose([np.degrees(tag.incidence) for tag in found], 25.0, atol=6)


def test_only_the_asked_ids_are_returned(picture):
    assert [tag.tag_id for tag in detect(picture, "tag36h11", {2, 5, 400})] == [2, 5]


def test_floor_is_added_to_every_variance(picture):
    plain, raised = (measure(picture, CAM, "tag36h11", 0.02, {4}, floor_px=floor)[0] for floor in (0.0, 0.01))
    np.testing.assert_allclose(raised.covariance_px2 - plain.covariance_px2, 1e-4 * np.eye(8), atol=1e-12)


@pytest.mark.parametrize(
    ("gates", "reason"),
    [
        (Gates(max_incidence=np.radians(10)), "incidence"),
        (Gates(min_cell_px=20), "cell"),
        (Gates(min_contrast=0.95), "contrast"),
        (Gates(chi2_base=0.1, chi2_sigmas=0), "chi2"),
        (Gates(max_seed_shift_cells=0, min_seed_shift_px=0), "seed"),
        (Gates(border_px=200), "frame"),
        (Gates(max_clipped=-1), "clipped"),
    ],
)
def test_every_gate_gives_its_reason(picture, gates, reason):
    (tag,) = measure(picture, CAM, "tag36h11", 0.02, {4}, gates)
    assert reason in tag.rejected


def test_a_covered_tag_is_rejected_or_not_found(picture):
    covered = picture.copy()
    x, y = TRUTH[4].mean(axis=0).astype(int)
    covered[y + 2 : y + 12, x : x + 12] = 235
    for tag in measure(covered, CAM, "tag36h11", 0.02, {4}):
        assert "chi2" in tag.rejected


def test_a_tag_that_shows_twice_is_rejected_twice(picture):
    double = np.concatenate([picture, picture], axis=1)
    camera = replace(CAM, width_px=1000)
    found = measure(double, camera, "tag36h11", 0.02, {4})
    assert len(found) == 2
    assert all(tag.rejected for tag in found)


def test_sixteen_bit_pictures_are_measured_alike(picture):
    light = ReferenceRenderer(SCENE, CAM).render(inverse(POSE))
    deep = measure(expose(light, CAM, noise_generator(1, 0), 16), CAM, "tag36h11", 0.02)
    flat = measure(picture, CAM, "tag36h11", 0.02)
    np.testing.assert_allclose([tag.corners_px for tag in deep], [tag.corners_px for tag in flat], atol=0.01)
    assert {tag.rejected for tag in deep} == {""}


def test_an_empty_picture_has_no_tags():
    assert measure(np.zeros((420, 500), np.uint8), CAM, "tag36h11", 0.02) == []


def test_an_unknown_sensor_is_judged_by_the_picture_itself(picture):
    camera = replace(CAM, full_well_e=4500.0)  # claims a third of the true noise
    assert all("chi2" in tag.rejected for tag in measure(picture, camera, "tag36h11", 0.02))
    found = measure(picture, camera, "tag36h11", 0.02, gates=Gates(own_noise=True))
    assert {tag.rejected for tag in found} == {""}
    right = measure(picture, CAM, "tag36h11", 0.02)
    ratio = [a.covariance_px2.trace() / b.covariance_px2.trace() for a, b in zip(found, right, strict=True)]
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)


def test_gamma_is_undone(picture):
    bent = np.rint(255 * (picture / 255.0) ** (1 / 2.2)).astype(np.uint8)
    straight = measure(linear(bent, 2.2), CAM, "tag36h11", 0.02)
    plain = measure(picture, CAM, "tag36h11", 0.02)
    np.testing.assert_allclose([tag.corners_px for tag in straight], [tag.corners_px for tag in plain], atol=0.01)


def test_large_tags_are_not_lost_to_the_outline_of_their_quiet_zone():
    """A tag and its quiet zone are two squares one inside the other: OpenCV must not take the wrong one for both."""
    rng = np.random.default_rng(0)
    camera = replace(
        CAM, width_px=320, height_px=240, focal_px=np.array([1200.0, 1200.0]),
        principal_point_px=np.array([157.3, 121.8]), distortion=np.array([-0.1, 0.02, 0.0005, -0.0003]),
    )  # fmt: skip
    corners = 0.02 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    square = Part(vertices=corners, faces=np.array([[0, 1, 2], [0, 2, 3]]))
    scene = replace(plate_scene(side=1, spacing=0.04, tag_size=0.02), part=square)
    # The first view is lost when outlines as far apart as an eighth of their length are taken together.
    views = [(7, np.array([0.08, -0.06, 0.24]), 0.3)]
    for tag in rng.choice(587, 15, replace=False).tolist():
        place = np.array([*rng.uniform(-0.2, 0.2, 2), 0.24]) * rng.uniform(0.9, 1.8)
        views.append((tag, place, rng.uniform(-3, 3)))
    for tag, place, roll in views:
        one = replace(scene, targets=replace(scene.targets, ids=np.array([tag])))
        light = ReferenceRenderer(one, camera).render(inverse(look_at(place, np.zeros(3), roll)))
        assert [item.tag_id for item in detect(expose(light, camera, None), "tag36h11")] == [tag]
