"""The expanded uncertainty of distances between object points, from the full covariance of a network."""

import numpy as np

from netdesign.errors import InputError
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.task import Task
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_error import TotalError, total_covariance
from netdesign.photogrammetry.visibility import sightings

SIGMA = "largest point sigma"
COVERAGE_FACTOR = 2.0  # k = 2, about 95 % for one degree of freedom (GUM 6.3)


def distance_functions(points: Floats, ends: Ints) -> Floats:
    """Return (3m, 7 + d): the datum of points (m, 3) and the derivatives of the distances ends (d, 2), projected to it.

    As ``total_trace.propagated`` takes them. (A distance depends on the datum through the scale only.)
    """
    basis = inner_basis(points)
    functions = np.zeros((len(ends), len(points), 3))
    across = points[ends[:, 1]] - points[ends[:, 0]]
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    functions[np.arange(len(ends)), ends[:, 0]], functions[np.arange(len(ends)), ends[:, 1]] = -across, across
    flat = functions.reshape(len(ends), 3 * len(points)).T
    return np.ascontiguousarray(np.hstack([basis, flat - basis @ (basis.T @ flat)]))


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


def distance_name(first: str, second: str) -> str:
    """Return what a requirement on a distance is called."""
    return f"U95 of the distance {first} to {second}"


def named_ends(task: Task) -> Ints:
    """Return (d, 2) the object points at the ends of the study's required distances.

    Raises:
        InputError: a name is not that of an object point, or both ends are the same.
    """
    ids = {name: index for index, name in enumerate(task.scene.targets.point_ids)}
    ends = []
    for item in task.study.requirements.distances:
        for name in (item.from_, item.to):
            if name not in ids:
                left_out = name.partition(".")[0] in map(str, task.left_out)
                why = ", a tag that targets.min_seen_share leaves out" if left_out else ""
                raise InputError(f"requirements.distances: expected tag.corner of the part, found {name!r}{why}")
        if item.from_ == item.to:
            raise InputError(f"requirements.distances: expected two object points, found {item.from_!r} twice")
        ends.append((ids[item.from_], ids[item.to]))
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


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
