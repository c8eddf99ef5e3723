"""What the rows of this folder share: the camera, the polyhedron, random views, errors against the truth."""

from pathlib import Path

import numpy as np

from netdesign.files.parts import load_part, load_targets
from netdesign.model.camera import Camera
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.scene import Scene
from netdesign.model.task import VisibilityLimits
from netdesign.photogrammetry.collinearity import project

DATASETS = Path(__file__).parents[2] / "datasets"
CAMERA = Camera(
    width_px=1600, height_px=1200, focal_px=np.array([2400.0, 2400.0]), principal_point_px=np.array([799.3, 599.8]),
    distortion=np.array([-0.12, 0.03, 0.0005, -0.0005]),
)  # fmt: skip
LIMITS = VisibilityLimits(
    max_incidence=np.radians(65), min_tag_px=20, border_px=10, min_rays=3, min_points_per_image=8, occlusion=True
)


def polyhedron():
    """The polyhedron of datasets/."""
    part = load_part(DATASETS / "parts" / "polyhedron.stl", "mm", np.eye(4))
    return Scene(
        part=part, targets=load_targets(DATASETS / "parts" / "polyhedron_tags.csv", "tag36h11", 0.02, np.eye(4))
    )


def stations(count, seed, near, far):
    """Random views with random roll."""
    random = np.random.default_rng(seed)
    viewpoints = np.column_stack([random.uniform(-np.pi, np.pi, count), random.uniform(0.15, 1.4, count)])
    aim = random.normal(scale=0.01, size=(count, 3))
    position = aim + random.uniform(near, far, count)[:, None] * sphere_directions(viewpoints)
    return look_at(position, aim, random.uniform(-np.pi, np.pi, count))


def compare(measured, scene, camera, pose, visible, floor_px):
    """Return errors (k, 8), NEES (k,), rejected errors, missed and false counts of one picture."""
    truth = project(pose, scene.targets.points, camera.intrinsics)[0].reshape(-1, 4, 2)
    row = {tag: index for index, tag in enumerate(scene.targets.ids.tolist())}
    errors, nees, rejected = [], [], []
    false = sum(tag.tag_id not in row and not tag.rejected for tag in measured)
    for tag in measured:
        if tag.tag_id not in row or not visible[row[tag.tag_id]]:
            continue
        error = (tag.corners_px - truth[row[tag.tag_id]]).ravel()
        if tag.rejected:
            rejected.append(error)
            continue
        covariance = tag.covariance_px2 + floor_px**2 * np.eye(8)
        errors.append(error)
        nees.append(error @ np.linalg.solve(covariance, error) / 8)
    found = {tag.tag_id for tag in measured}
    missed = sum(bool(visible[index]) and tag not in found for tag, index in row.items())
    return errors, nees, rejected, missed, false
