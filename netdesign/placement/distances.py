"""The expanded uncertainty of distances between object points, from the full covariance of a network."""

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.task import Task
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_error import TotalError, total_covariance
from netdesign.photogrammetry.visibility import sightings

COVERAGE_FACTOR = 2.0  # k = 2, about 95 % for one degree of freedom (GUM 6.3)


def network_total_error(task: Task, world_from_cam: Floats, visible: Bools | None = None) -> TotalError:
    """Return the total error propagation of images with poses (n, 4, 4) m.

    Args:
        visible: (n, m) which image sees which object point; default: the exact sightings of the study.
    """
    if visible is None:
        visible = sightings(task.scene, task.camera, world_from_cam, task.limits).visible
    sigma = sighting_sigma(task.camera, world_from_cam, task.scene.targets)
    targets, stations = task.scene.targets, [str(number + 1) for number in range(len(world_from_cam))]
    return total_covariance(
        world_from_cam, targets.points, task.camera.intrinsics, visible, sigma,
        image_names=stations, point_names=targets.point_ids,
    )  # fmt: skip


def distance_u95(task: Task, world_from_cam: Floats, ends: Ints) -> Floats:
    """Return (k,) U95 in m of the distances between the object points ends (k, 2), coverage factor 2.

    With the unit vector e from a to b, u² = eᵀ (Caa + Cbb - Cab - Cba) e. Datum: inner constraints over all object
    points; it fixes the scale too, so an uncertainty of the scale comes on top. inf when the network is not determined.
    """
    total = network_total_error(task, world_from_cam)
    if not total.determined:
        return np.full(len(ends), np.inf)
    points = task.scene.targets.points
    count = len(points)
    joint = total.joint().reshape(count, 3, count, 3)
    first, second = np.asarray(ends)[:, 0], np.asarray(ends)[:, 1]
    across = points[second] - points[first]
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    spread = joint[first, :, first] + joint[second, :, second] - joint[first, :, second] - joint[second, :, first]
    variance = np.einsum("ki,kij,kj->k", across, spread, across)
    return np.asarray(COVERAGE_FACTOR * np.sqrt(variance))
