"""One point through every library: the same pixel, whoever projects, draws or detects it.

A sign, an axis or half a pixel wrong anywhere makes results that look right and are not; this file is the tripwire.
"""

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pycolmap
import pytest

from netdesign.imaging.detect import detect, pose_from_tag
from netdesign.imaging.measure import measure
from netdesign.imaging.optics import expose
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.imaging.render import Renderer
from netdesign.model.frames import inverse, look_at, sphere_directions, transform
from netdesign.photogrammetry.collinearity import project
from tests.scenes import CAMERA, plate_scene

LENS = replace(
    CAMERA, width_px=800, height_px=600, focal_px=np.array([1500.0, 1510.0]),
    principal_point_px=np.array([398.7, 301.2]), distortion=np.array([-0.15, 0.05, 0.001, -0.002]),
)  # fmt: skip
SCENE = plate_scene(side=3, spacing=0.05, tag_size=0.03)
POSE = look_at(0.45 * sphere_directions(np.radians([20.0, 75.0])), np.zeros(3), 0.35)
CORNERS_PX = project(POSE, SCENE.targets.points, LENS.intrinsics)[0].reshape(-1, 4, 2)


def test_projections_agree_between_opencv_gtsam_colmap_and_ours():
    points = np.vstack([SCENE.targets.points, [[0.01, -0.02, 0.03], [-0.07, 0.05, -0.02]]])
    ours, _ = project(POSE, points, LENS.intrinsics)
    cam_from_world = inverse(POSE)
    fx, fy, cx, cy, *distortion = LENS.intrinsics
    rotation_vector, _ = cv2.Rodrigues(cam_from_world[:3, :3])
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    opencv, _ = cv2.projectPoints(points, rotation_vector, cam_from_world[:3, 3], matrix, np.array(distortion))
    np.testing.assert_allclose(opencv[:, 0], ours, atol=1e-9)

    calibration = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *distortion)
    camera = gtsam.PinholeCameraCal3DS2(gtsam.Pose3(POSE), calibration)
    np.testing.assert_allclose([camera.project(point) for point in points], ours, atol=1e-9)

    colmap = pycolmap.Camera(
        model="OPENCV", width=LENS.width_px, height=LENS.height_px, params=[fx, fy, cx + 0.5, cy + 0.5, *distortion]
    )
    placed = pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world[:3, :3]), cam_from_world[:3, 3])
    seen = np.array([colmap.img_from_cam(placed * point) for point in points])
    np.testing.assert_allclose(seen - 0.5, ours, atol=1e-9)


@pytest.mark.parametrize("renderer", [Renderer(SCENE, LENS, 2), ReferenceRenderer(SCENE, LENS)])
def test_rendered_and_detected_tags_lie_where_they_are_projected(renderer):
    picture = expose(renderer.render(inverse(POSE)), LENS, None)
    found = detect(picture, "tag36h11", range(9))
    assert [tag.tag_id for tag in found] == list(range(9))
    centres = CORNERS_PX.mean(axis=1)
    # OpenCV places a single corner to some tenths of a pixel; centres average that out, half a pixel would not.
    offset = np.array([tag.corners_px.mean(axis=0) for tag in found]) - centres
    np.testing.assert_allclose(offset.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(offset, 0.0, atol=0.05)
    measured = measure(picture, LENS, "tag36h11", 0.03, range(9))
    assert [tag.rejected for tag in measured] == [""] * 9
    np.testing.assert_allclose([tag.corners_px.mean(axis=0) for tag in measured], centres, atol=0.005)
    np.testing.assert_allclose([tag.corners_px for tag in measured], CORNERS_PX, atol=0.02)


@pytest.mark.parametrize("make", [lambda s, c: Renderer(s, c, 4), ReferenceRenderer], ids=["pyrender", "reference"])
def test_every_tag_centre_that_opencv_finds_lies_within_a_fiftieth_of_a_pixel(make):
    # Large tags and a window of a third of a cell: OpenCV's own best, with nothing of ours but the picture.
    lens = replace(
        LENS, width_px=1600, height_px=1200, focal_px=np.array([3000.0, 3010.0]),
        principal_point_px=np.array([798.7, 601.2]),
    )  # fmt: skip
    scene = plate_scene(side=3, spacing=0.055, tag_size=0.03)
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementWinSize = 8
    settings.relativeCornerRefinmentWinSize = 0.9
    settings.cornerRefinementMaxIterations = 100
    settings.cornerRefinementMinAccuracy = 1e-4
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), settings)
    renderer = make(scene, lens)
    for elevation, roll in ((75.0, 0.35), (60.0, 1.0)):
        pose = look_at(0.45 * sphere_directions(np.radians([20.0, elevation])), np.zeros(3), roll)
        centres = project(pose, scene.targets.points, lens.intrinsics)[0].reshape(-1, 4, 2).mean(axis=1)
        corners, ids, _ = detector.detectMarkers(expose(renderer.render(inverse(pose)), lens, None))
        assert len(ids) >= 8
        found = np.array([corner.reshape(4, 2).mean(axis=0) for corner in corners])
        np.testing.assert_allclose(found, centres[ids.ravel()], atol=0.02)


def test_pose_from_a_tag_is_the_camera_that_saw_it():
    targets = SCENE.targets
    up = np.cross(targets.normals, targets.x_axes)
    for tag in range(len(targets.ids)):
        tag_from_cam, error_px = pose_from_tag(CORNERS_PX[tag], targets.size_m, LENS.intrinsics)[0]
        world_from_tag = np.eye(4)
        world_from_tag[:3, :3] = np.column_stack([targets.x_axes[tag], up[tag], targets.normals[tag]])
        world_from_tag[:3, 3] = targets.centres[tag]
        assert error_px < 1e-4
        np.testing.assert_allclose(transform(world_from_tag, tag_from_cam[:3, 3]), POSE[:3, 3], atol=1e-5)
        np.testing.assert_allclose((world_from_tag @ tag_from_cam)[:3, :3], POSE[:3, :3], atol=1e-5)


def test_a_camera_at_its_target_looks_straight_down():
    """A box of stations may contain the point that all look at."""
    poses = look_at(np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 0.4]]), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(poses[0, :3, :3], poses[1, :3, :3])
