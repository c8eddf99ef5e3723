"""Collision shapes as triangles."""

from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from netdesign.errors import InputError
from netdesign.model.arrays import Floats, Ints


def triangles(shape: Any, name: str) -> tuple[Floats, Ints]:
    """Return vertices (v, 3) and faces (t, 3) of a collision shape; a round one is covered from outside."""
    kind = type(shape).__name__
    if kind.startswith("BVHModel"):
        corners = [shape.tri_indices(index) for index in range(shape.num_tris)]
        faces = [[corner[0], corner[1], corner[2]] for corner in corners]
        return np.array(shape.vertices()), np.array(faces, dtype=np.int64)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    if kind == "Box":
        return _hull(signs * np.asarray(shape.halfSide))
    if kind in ("Cylinder", "Cone", "Capsule", "Sphere"):
        half = getattr(shape, "halfLength", 0.0) + (shape.radius if kind in ("Capsule", "Sphere") else 0.0)
        angles = np.arange(16) * (2.0 * np.pi / 16)
        ring = shape.radius / np.cos(np.pi / 16) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return _hull(np.array([[x, y, z] for x, y in ring for z in (-half, half)]))
    raise InputError(f"robot.urdf: {name}: expected a mesh, box, cylinder, capsule or sphere, found {kind}")


def _hull(points: Floats) -> tuple[Floats, Ints]:
    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return points, faces
