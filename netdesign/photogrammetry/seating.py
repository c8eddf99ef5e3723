"""How tags sit on the part: which overlap each other, which stand off the surface."""

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.scene import CORNERS_PER_TAG, Part, Targets

SAME_PLANE = np.cos(np.radians(10.0))  # between the normals of two tags of which one would cover the other
LAYER = 0.1  # edges; tags farther apart along the normal lie on different surfaces
TOUCH = 0.01  # edges; squares that share less only touch


def overlapping(targets: Targets) -> list[tuple[int, int]]:
    """Return the ids of the pairs of tags whose black squares share area on one surface.

    Two convex shapes in a plane are apart if and only if the normal of an edge of one of them separates them.
    """
    corners = targets.points.reshape(-1, CORNERS_PER_TAG, 3)
    y_axes = np.cross(targets.normals, targets.x_axes)
    pairs = []
    for one in range(len(corners)):
        offset = targets.centres[one + 1 :] - targets.centres[one]
        height = np.abs(offset @ targets.normals[one])
        near = np.linalg.norm(offset, axis=1) < np.sqrt(2.0) * targets.size_m
        alike = targets.normals[one + 1 :] @ targets.normals[one] > SAME_PLANE
        for other in (one + 1 + np.flatnonzero(near & alike & (height < LAYER * targets.size_m))).tolist():
            axes = np.stack([targets.x_axes[one], y_axes[one], targets.x_axes[other], y_axes[other]])
            first, second = corners[one] @ axes.T, corners[other] @ axes.T
            shared = np.minimum(first.max(axis=0), second.max(axis=0)) - np.maximum(
                first.min(axis=0), second.min(axis=0)
            )
            if (shared > TOUCH * targets.size_m).all():
                pairs.append((int(targets.ids[one]), int(targets.ids[other])))
    return pairs


def gap_to_surface(part: Part, points: Floats) -> Floats:
    """Return the distance (k,) of points (k, 3) from the nearest triangle of the part, in its unit."""
    triangles = part.triangles
    middle = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    found = np.empty(len(points))
    for index, point in enumerate(points):
        away = np.linalg.norm(middle - point, axis=1)
        near = away - reach <= (away + reach).min()
        found[index] = _distances(point, triangles[near]).min()
    return found


def _distances(point: Floats, triangles: Floats) -> Floats:
    """Return the distance (t,) of a point (3,) from triangles (t, 3, 3): to the plane inside, to the edges outside."""
    edge = np.roll(triangles, -1, axis=1) - triangles
    offset = point - triangles
    along = np.einsum("tki,tki->tk", offset, edge) / np.maximum(np.einsum("tki,tki->tk", edge, edge), 1e-300)
    to_edges = np.linalg.norm(offset - np.clip(along, 0.0, 1.0)[..., None] * edge, axis=2).min(axis=1)
    normal = np.cross(edge[:, 0], edge[:, 1])
    length = np.linalg.norm(normal, axis=1)
    side = np.einsum("tki,tki->tk", np.cross(edge, offset), np.broadcast_to(normal[:, None], edge.shape))
    inside = (side >= 0).all(axis=1) & (length > 0)
    to_plane = np.abs(np.einsum("ti,ti->t", offset[:, 0], normal)) / np.maximum(length, 1e-300)
    return np.asarray(np.where(inside, np.minimum(to_plane, to_edges), to_edges))
