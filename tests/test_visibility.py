from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from netdesign.model.frames import look_at, pose, sphere_directions, transform
from netdesign.model.scene import Part, Scene, Targets
from netdesign.photogrammetry.visibility import REASONS, monotone_radius_squared, sightings
from tests.scenes import CAMERA, LIMITS, box_part, box_scene, plate_scene, ring
from tests.test_bvh import every_triangle

seeds = st.integers(0, 2**32 - 1)


def random_poses(rng, count, radius=0.6, spread=0.05):
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return look_at(radius * directions, spread * rng.normal(size=(count, 3)), rng.uniform(-np.pi, np.pi, count))


def bracket_scene():
    """An upright wall on a plate, with tags on the plate and on both sides of the wall."""
    plate, wall = box_part((0.3, 0.3, 0.01), (0, 0, -0.005)), box_part((0.01, 0.2, 0.12), (0, 0, 0.06))
    part = Part(
        vertices=np.concatenate([plate.vertices, wall.vertices]),
        faces=np.concatenate([plate.faces, wall.faces + len(plate.vertices)]),
    )
    rows = [((x, y, 0), (0, 0, 1), (1, 0, 0)) for x in (-0.1, -0.05, 0.05, 0.1) for y in (-0.1, 0, 0.1)]
    rows += [((s * 0.005, y, 0.06), (s, 0, 0), (0, s, 0)) for s in (-1, 1) for y in (-0.05, 0.05)]
    centres, normals, x_axes = (np.array(column, float) for column in zip(*rows, strict=True))
    targets = Targets(ids=np.arange(len(rows)), centres=centres, normals=normals, x_axes=x_axes, size_m=0.02)
    return Scene(part=part, targets=targets)


def one_tag(size=0.02):
    """A single tag at the origin that looks up, on nothing."""
    part = Part(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3)))
    targets = Targets(ids=[0], centres=[[0, 0, 0]], normals=[[0, 0, 1]], x_axes=[[1, 0, 0]], size_m=size)
    return Scene(part=part, targets=targets)


def outcome(scene, poses, camera=CAMERA, limits=LIMITS):
    return [REASONS[k] for k in sightings(scene, camera, poses, limits).reason[:, 0]]


def plain_python(scene, camera, poses, limits):
    """The definition of the contract, written down a second time with OpenCV's projection."""
    targets, reason = scene.targets, np.zeros((len(poses), len(scene.targets.ids)), int)
    fx, fy, cx, cy = camera.intrinsics[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    near, far = camera.depth_of_field()
    low = limits.border_px - 0.5
    size = np.array([camera.width_px, camera.height_px])
    corners = targets.points.reshape(-1, 4, 3)
    for i, world_from_cam in enumerate(poses):
        cam_from_world = np.linalg.inv(world_from_cam)
        camera_centre = world_from_cam[:3, 3]
        for g in range(len(corners)):
            inside = transform(cam_from_world, corners[g])
            rays = camera_centre - corners[g]
            cosines = rays @ targets.normals[g] / np.linalg.norm(rays, axis=1)
            xy = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), matrix, camera.distortion)[0][:, 0]
            radius = ((inside[:, :2] / inside[:, 2:]) ** 2).sum(axis=1)
            edges = np.linalg.norm(xy - np.roll(xy, 1, axis=0), axis=1)
            ends = np.concatenate([corners[g], targets.centres[g : g + 1]])
            ends = ends + 1e-3 * targets.size_m / ((camera_centre - ends) @ targets.normals[g])[:, None] * (
                camera_centre - ends
            )
            tests = [
                (inside[:, 2] <= 0).any(),
                (cosines < np.cos(limits.max_incidence)).any(),
                (xy < low).any() or (xy > size - 1 - low).any() or (radius > monotone_radius_squared(camera)).any(),
                edges.min() < limits.min_tag_px,
                (inside[:, 2] < near).any() or (inside[:, 2] > far).any(),
                limits.occlusion and every_triangle(scene.part.triangles, np.tile(camera_centre, (5, 1)), ends).any(),
            ]
            reason[i, g] = np.argmax(tests) + 1 if any(tests) else 0
    return reason


@given(seed=seeds)
@settings(deadline=None, max_examples=15)
def test_a_convex_part_never_hides_a_tag_that_faces_the_camera(seed):
    rng = np.random.default_rng(seed)
    limits = replace(LIMITS, max_incidence=np.radians(rng.uniform(20, 89.9)))
    counts = sightings(box_scene(), CAMERA, random_poses(rng, 50), limits).refusals()
    assert counts["occluded"] == 0
    assert sum(counts.values()) == 50 * len(box_scene().targets.ids)


@given(seed=seeds)
@settings(deadline=None, max_examples=15)
def test_moving_scene_and_cameras_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    scene, poses = bracket_scene(), random_poses(rng, 40)
    move = pose(Rotation.random(random_state=seed % 1000).as_matrix(), rng.normal(size=3))
    targets = scene.targets
    moved = Scene(
        part=Part(vertices=transform(move, scene.part.vertices), faces=scene.part.faces),
        targets=replace(
            targets,
            centres=transform(move, targets.centres),
            normals=targets.normals @ move[:3, :3].T,
            x_axes=targets.x_axes @ move[:3, :3].T,
        ),
    )
    before, after = (sightings(s, CAMERA, p, LIMITS).reason for s, p in ((scene, poses), (moved, move @ poses)))
    np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("distortion", [[0, 0, 0, 0], [-0.2, 0.1, 0.001, -0.002], [-0.4, 0, 0, 0]])
def test_every_reason_agrees_with_the_definition_written_in_plain_numpy(distortion):
    rng = np.random.default_rng(5)
    camera = replace(
        CAMERA, distortion=np.array(distortion), focal_px=np.array([2500.0, 2600]), pixel_m=3.45e-6, f_number=5.6,
        focus_m=0.55,
    )  # fmt: skip
    limits = replace(LIMITS, min_tag_px=60)
    directions = sphere_directions(np.stack([rng.uniform(-3, 3, 60), rng.uniform(0.1, 1.5, 60)], axis=1))
    poses = look_at(
        rng.uniform(0.4, 0.75, (60, 1)) * directions, 0.1 * rng.normal(size=(60, 3)), rng.uniform(-3, 3, 60)
    )
    for scene in (bracket_scene(), box_scene(spacing=0.1)):
        found = sightings(scene, camera, poses, limits).reason
        np.testing.assert_array_equal(found, plain_python(scene, camera, poses, limits))
    reasons = sightings(bracket_scene(), camera, poses, limits).refusals()
    assert min(reasons[name] for name in REASONS if name != "behind") > 3, "the sample meets every reason"


def test_behind_the_camera():
    away = look_at(np.array([[0, 0, 0.5]]), np.array([[0, 0, 1.0]]))
    assert outcome(one_tag(), away) == ["behind"]


def test_incidence_at_the_limit():
    # The two corners farthest from the camera are seen most obliquely: put exactly them a hair off 60 degrees.
    scene, limits = one_tag(), replace(LIMITS, max_incidence=np.radians(60))
    for hair, expected in ((-1e-6, "seen"), (1e-6, "incidence")):
        camera = np.array([0.5, 0, np.hypot(0.51, 0.01) / np.tan(np.radians(60) + hair)])
        assert outcome(scene, look_at(camera[None], np.zeros(3)), limits=limits) == [expected]


def test_the_frame_ends_half_a_pixel_outside_the_outermost_pixel_centres():
    # Straight from above, 0.6 m, 20 mm = 120 px: shifting the camera in x moves the tag 6 px per mm.
    scene = one_tag()
    for border in (0.0, 10.0):
        for hair, expected in ((-1e-3, "seen"), (1e-3, "frame")):
            edge = CAMERA.width_px - 0.5 - border + hair
            shift = 0.01 - (edge - CAMERA.principal_point_px[0]) / CAMERA.focal_px[0] * 0.6
            camera = pose(np.diag([1.0, -1, -1]), np.array([shift, 0, 0.6]))
            assert outcome(scene, camera[None], limits=replace(LIMITS, border_px=border)) == [expected]


def test_the_shortest_edge_counts():
    # From above every edge is f * size / z px; tilted by 60 degrees about x two of them are halved (far away).
    scene = one_tag()
    for size, expected in ((119.9, "seen"), (120.1, "size")):
        overhead = look_at(np.array([[0, 0, 0.6]]), np.zeros(3))
        assert outcome(scene, overhead, limits=replace(LIMITS, min_tag_px=size)) == [expected]
    far_camera = replace(CAMERA, focal_px=np.array([3.6e5, 3.6e5]))
    tilted = look_at(60 * sphere_directions(np.array([[np.pi / 2, np.radians(30)]])), np.zeros(3))
    for size, expected in ((59.9, "seen"), (60.1, "size")):
        assert outcome(scene, tilted, far_camera, replace(LIMITS, min_tag_px=size)) == [expected]


def test_depth_of_field():
    camera = replace(CAMERA, pixel_m=3.45e-6, f_number=8.0, focus_m=0.6)
    near, far = camera.depth_of_field()
    assert 0.45 < near < 0.6 < far < 0.8
    for height, expected in (
        (near - 1e-6, "depth of field"), (near + 1e-6, "seen"), (far - 1e-6, "seen"), (far + 1e-6, "depth of field"),
    ):  # fmt: skip
        assert outcome(one_tag(), look_at(np.array([[0, 0, height]]), np.zeros(3)), camera) == [expected]


def test_strong_distortion_does_not_fold_far_points_into_the_frame():
    # r (1 - 0.4 r²) turns at r = 0.913; at r = 1.58 it is back at the principal point.
    camera = replace(CAMERA, distortion=np.array([-0.4, 0, 0, 0]))
    assert monotone_radius_squared(camera) == pytest.approx(1 / 1.2)
    limits = replace(LIMITS, min_tag_px=0, max_incidence=np.radians(89))
    shift = 0.6 * np.sqrt(1 / 0.4)
    overhead = pose(np.diag([1.0, -1, -1]), np.array([shift, 0, 0.6]))
    assert outcome(one_tag(0.001), overhead[None], camera, limits) == ["frame"]


def test_a_wall_hides_the_tags_behind_it_and_only_those():
    scene = bracket_scene()
    low = look_at(np.array([[0.45, 0.0, 0.35]]), np.zeros(3))
    reason = sightings(scene, CAMERA, low, LIMITS).reason[0]
    x, y = scene.targets.centres[:, 0], scene.targets.centres[:, 1]
    plate = np.arange(len(x)) < 12
    assert (reason[plate & (x > 0)] == 0).all()
    assert (reason[plate & (x < 0) & (y == 0)] == REASONS.index("occluded")).all()
    without = sightings(scene, CAMERA, low, replace(LIMITS, occlusion=False)).reason[0]
    assert (without[plate] == 0).all()


def test_points_of_a_tag_share_its_fate_and_no_image_is_no_problem():
    scene = plate_scene()
    seen = sightings(scene, CAMERA, ring(5), LIMITS)
    assert seen.visible.shape == (5, 100)
    assert seen.visible.all()
    assert sightings(scene, CAMERA, np.zeros((0, 4, 4)), LIMITS).visible.shape == (0, 100)
