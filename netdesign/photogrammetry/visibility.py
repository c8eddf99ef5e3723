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

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.scene import CORNERS_PER_TAG, Scene, Targets
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import VisibilityLimits
from netdesign.photogrammetry.bvh import TriangleTree

REASONS = ("seen", "behind", "incidence", "frame", "size", "depth of field", "occluded")
SEEN, BEHIND, INCIDENCE, FRAME, SIZE, DEPTH_OF_FIELD, OCCLUDED = range(len(REASONS))

SAMPLE_STEP = np.radians(2.0)  # between the viewpoints that stand for a whole sphere

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


def seen_share(scene: Scene, camera: Camera, sphere: ViewingSphere, limits: VisibilityLimits) -> Floats:
    """Return (g,) the share of the admissible sphere from which each tag is seen, sampled at ``SAMPLE_STEP``."""
    viewpoints, weights = sphere.sample(SAMPLE_STEP)
    share: Floats = weights @ sightings(scene, camera, sphere.cameras(viewpoints), limits).visible_tags
    return share


class Sight:
    """Scene, camera and limits prepared for repeated questions."""

    def __init__(self, scene: Scene, camera: Camera, limits: VisibilityLimits) -> None:
        mesh = scene.part.triangles if limits.occlusion else np.zeros((0, 3, 3))
        self.points = sight_points(scene.targets)
        self.normals = np.ascontiguousarray(scene.targets.normals)
        self.settings = sight_settings(camera, limits, scene.targets.size_m)
        self.shadowed = shadowed(mesh, self.points, self.normals, self.settings[16])
        self.tree = TriangleTree.build(mesh if self.shadowed.any() else mesh[:0])

    def look(self, world_from_cam: Floats) -> Sightings:
        """Return the sightings of images with poses (n, 4, 4)."""
        poses = np.asarray(world_from_cam, dtype=np.float64)
        reason = np.zeros((len(poses), len(self.points)), dtype=np.int8)
        at_once = max(1, 200_000 // max(len(self.points), 1))
        for first in range(0, len(poses), at_once):
            images = slice(first, first + at_once)
            reason[images] = _unobstructed(poses[images], self.points[:, :CORNERS_PER_TAG], self.normals, self.settings)
        image, tag = np.nonzero((reason == SEEN) & self.shadowed)
        if image.size:
            reason[image, tag] = np.where(self._blocked(poses[image, :3, 3], tag), OCCLUDED, SEEN)
        return Sightings(reason=reason)

    def _blocked(self, stations: Floats, tag: Ints) -> Bools:
        """(k,): the mesh hides a corner or the centre of tag (k,) from a camera at stations (k, 3)."""
        ends = self.points[tag]
        height = np.einsum("kpj,kj->kp", stations[:, None] - ends, self.normals[tag])
        low = height <= self.settings[16]
        share = self.settings[16] / np.where(low, 1.0, height)
        ends = ends + share[..., None] * (stations[:, None] - ends)
        origins = np.repeat(stations, ends.shape[1], axis=0)
        hit = self.tree.blocked(origins, ends.reshape(-1, 3)).reshape(low.shape)
        return np.asarray((low | hit).any(axis=1))


def shadowed(mesh: Floats, points: Floats, normals: Floats, clearance: float) -> Bools:
    """Return (g,) whether a vertex of the mesh (t, 3, 3) rises above a tag's plane: on a convex part none does."""
    vertices = np.unique(mesh.reshape(-1, 3), axis=0)
    if not len(vertices):
        return np.zeros(len(points), dtype=bool)
    heights = (vertices @ normals.T).max(axis=0) - np.einsum("gj,gj->g", points[:, 4], normals)
    return np.asarray(heights > clearance)


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


def _unobstructed(poses: Floats, corners: Floats, normals: Floats, settings: Floats) -> NDArray[np.int8]:
    """First reason, but for occlusion, why each of the n images does not see tags with corners (g, 4, 3): (n, g)."""
    fx, fy, cx, cy, k1, k2, p1, p2 = settings[:8]
    offset = corners[None] - poses[:, None, None, :3, 3]
    inside = offset @ poses[:, None, :3, :3]
    z = inside[..., 2]
    behind = z <= 0.0
    x, y = np.moveaxis(inside[..., :2] / np.where(behind, 1.0, z)[..., None], -1, 0)
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * k2)
    u = fx * (x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)) + cx
    v = fy * (y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
    facing = -np.einsum("ngkj,gj->ngk", offset, normals)
    oblique = facing < settings[12] * np.linalg.norm(offset, axis=-1)
    left, right, top, bottom = settings[8:12]
    outside = (s > settings[17]) | (u < left) | (u > right) | (v < top) | (v > bottom)
    edges = (u - np.roll(u, 1, axis=-1)) ** 2 + (v - np.roll(v, 1, axis=-1)) ** 2
    blurred = (z < settings[14]) | (z > settings[15])
    tests = [
        behind.any(axis=-1),
        oblique.any(axis=-1),
        outside.any(axis=-1),
        edges.min(axis=-1, initial=np.inf) < settings[13] ** 2,
        blurred.any(axis=-1),
    ]
    reason = np.select(tests, [BEHIND, INCIDENCE, FRAME, SIZE, DEPTH_OF_FIELD], default=SEEN)
    return np.asarray(reason, dtype=np.int8)
