"""Which tag is seen from where, and if not, why not (contract, section 5).

A tag is seen when its four corners (and, for occlusion, its centre) pass these tests, in this order; the first one that
fails is the reason that is kept:

1. behind: a corner does not lie in front of the camera;
2. incidence: the angle between the outward normal and the direction from a corner to the camera exceeds the limit;
3. frame: a corner falls outside the frame less the border, distortion included;
4. size: the shortest of the tag's four edges in the image is shorter than the limit;
5. depth of field: a corner is nearer or farther (along the optical axis) than is sharp;
6. occluded: the part blocks the line of sight to a corner or to the centre.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.scene import CORNERS_PER_TAG, Scene, Targets
from netdesign.model.task import VisibilityLimits
from netdesign.photogrammetry.bvh import TriangleTree, blocking_triangle

REASONS = ("seen", "behind", "incidence", "frame", "size", "depth of field", "occluded")
SEEN, BEHIND, INCIDENCE, FRAME, SIZE, DEPTH_OF_FIELD, OCCLUDED = range(len(REASONS))

# A line of sight ends this share of the tag's edge above the tag's plane: the tag lies on the mesh, and files round.
CLEARANCE = 1e-3


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """The outcome for every image and tag.

    Attributes:
        reason: (n, g) int8, index into REASONS; 0 = seen.
    """

    reason: NDArray[np.int8]

    @property
    def visible_tags(self) -> Bools:
        """(n, g): the tag is seen."""
        return np.equal(self.reason, SEEN)

    @property
    def visible(self) -> Bools:
        """(n, m): the object point is seen; all four corners of a tag share its fate."""
        return np.repeat(self.reason == SEEN, CORNERS_PER_TAG, axis=1)

    def refusals(self) -> dict[str, int]:
        """Return how many sightings ended with each of REASONS, "seen" included."""
        return dict(zip(REASONS, np.bincount(self.reason.ravel(), minlength=len(REASONS)).tolist(), strict=True))


def sightings(scene: Scene, camera: Camera, world_from_cam: Floats, limits: VisibilityLimits) -> Sightings:
    """Return which of the g tags each of the n images with poses (n, 4, 4) sees: exact, ray by ray.

    To ask many times about one scene, keep ``Sight(scene, camera, limits)`` and call its ``look``.
    """
    return Sight(scene, camera, limits).look(world_from_cam)


class Sight:
    """Scene, camera and limits prepared for repeated questions."""

    def __init__(self, scene: Scene, camera: Camera, limits: VisibilityLimits) -> None:
        self.tree = TriangleTree.build(scene.part.triangles if limits.occlusion else np.zeros((0, 3, 3)))
        self.points = sight_points(scene.targets)
        self.normals = np.ascontiguousarray(scene.targets.normals)
        self.settings = sight_settings(camera, limits, scene.targets.size_m)

    def look(self, world_from_cam: Floats) -> Sightings:
        """Return the sightings of images with poses (n, 4, 4)."""
        poses = np.ascontiguousarray(world_from_cam, dtype=np.float64)
        tree = self.tree
        reason = _look(poses, self.points, self.normals, self.settings, tree.bounds, tree.starts, tree.triangles)
        return Sightings(reason=reason)


def sight_points(targets: Targets) -> Floats:
    """Return (g, 5, 3): four corners and the centre of every tag, m."""
    corners = targets.points.reshape(-1, CORNERS_PER_TAG, 3)
    return np.ascontiguousarray(np.concatenate([corners, targets.centres[:, None]], axis=1))


def sight_settings(camera: Camera, limits: VisibilityLimits, tag_size: float) -> Floats:
    """Return (18,): the numbers the kernels need, by position.

    0-7 intrinsics; 8-11 lowest and highest x, lowest and highest y in px; 12 cos of the incidence limit; 13 shortest
    edge px; 14, 15 near and far m; 16 clearance m; 17 largest r² (normalised) with a monotone distortion.
    """
    border = limits.border_px
    near, far = camera.depth_of_field()
    # Pixel centres run from 0 to width - 1; the frame itself from -0.5 to width - 0.5.
    frame = [border - 0.5, camera.width_px - 0.5 - border, border - 0.5, camera.height_px - 0.5 - border]
    return np.array(
        [*camera.intrinsics, *frame, np.cos(limits.max_incidence), limits.min_tag_px, near, far]
        + [CLEARANCE * tag_size, monotone_radius_squared(camera)]
    )


def monotone_radius_squared(camera: Camera) -> float:
    """Return the largest r² (normalised, undistorted) up to which the radial distortion keeps growing; may be inf.

    The image radius r (1 + k1 r² + k2 r⁴) has the derivative 1 + 3 k1 s + 5 k2 s², s = r². Beyond its first positive
    root the polynomial folds back and would put far-away points into the frame.
    """
    k1, k2 = camera.distortion[:2].tolist()
    roots = np.roots([5 * k2, 3 * k1, 1.0])
    positive = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(positive.min()) if positive.size else float("inf")


@numba.njit(cache=True, error_model="numpy")
def _look(
    poses: Floats, points: Floats, normals: Floats, settings: Floats, bounds: Floats, starts: Ints, triangles: Floats
) -> NDArray[np.int8]:
    reason = np.zeros((len(poses), len(points)), np.int8)
    for i in range(len(poses)):
        for g in range(len(points)):
            outcome = unobstructed(poses[i], points[g], normals[g], settings)
            if outcome == SEEN:
                x, y, z = poses[i, 0, 3], poses[i, 1, 3], poses[i, 2, 3]
                if tag_blocked(x, y, z, points[g], normals[g], settings[16], bounds, starts, triangles):
                    outcome = OCCLUDED
            reason[i, g] = outcome
    return reason


@numba.njit(cache=True, error_model="numpy")
def tag_blocked(
    cx: float, cy: float, cz: float, points: Floats, normal: Floats, clearance: float, bounds: Floats, starts: Ints,
    triangles: Floats,
) -> bool:  # fmt: skip
    """Tell whether the mesh hides one of a tag's five points (5, 3) from a camera at c."""
    for k in range(4, -1, -1):
        dx, dy, dz = points[k, 0] - cx, points[k, 1] - cy, points[k, 2] - cz
        height = -(dx * normal[0] + dy * normal[1] + dz * normal[2])
        if height <= clearance:
            return True
        share = 1.0 - clearance / height
        if blocking_triangle(cx, cy, cz, dx * share, dy * share, dz * share, bounds, starts, triangles) >= 0:
            return True
    return False


@numba.njit(cache=True, error_model="numpy")
def unobstructed(pose: Floats, points: Floats, normal: Floats, settings: Floats) -> int:
    """Return the first reason, but for occlusion, why a tag with points (5, 3) is not seen; 0 when it is."""
    fx, fy, cx, cy = settings[0], settings[1], settings[2], settings[3]
    k1, k2, p1, p2 = settings[4], settings[5], settings[6], settings[7]
    behind = incidence = frame = blurred = False
    shortest = np.inf
    first_x = first_y = last_x = last_y = 0.0
    for k in range(4):
        dx, dy, dz = points[k, 0] - pose[0, 3], points[k, 1] - pose[1, 3], points[k, 2] - pose[2, 3]
        z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
        if z <= 0.0:
            behind = True
            break
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if -(dx * normal[0] + dy * normal[1] + dz * normal[2]) < settings[12] * distance:
            incidence = True
        x = (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / z
        y = (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / z
        s = x * x + y * y
        radial = 1.0 + s * (k1 + s * k2)
        u = fx * (x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)) + cx
        v = fy * (y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
        if s > settings[17] or not (settings[8] <= u <= settings[9] and settings[10] <= v <= settings[11]):
            frame = True
        if z < settings[14] or z > settings[15]:
            blurred = True
        if k == 0:
            first_x, first_y = u, v
        else:
            shortest = min(shortest, (u - last_x) ** 2 + (v - last_y) ** 2)
        last_x, last_y = u, v
    if behind:
        return BEHIND
    if incidence:
        return INCIDENCE
    if frame:
        return FRAME
    if min(shortest, (first_x - last_x) ** 2 + (first_y - last_y) ** 2) < settings[13] ** 2:
        return SIZE
    return DEPTH_OF_FIELD if blurred else SEEN
