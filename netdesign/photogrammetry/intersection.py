"""Spatial intersection: rays of image points, and the object points nearest to all their rays."""

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.photogrammetry.collinearity import distort

ROUNDS = 30


def viewing_rays(world_from_cam: Floats, xy_px: Floats, intrinsics: Floats) -> Floats:
    """Return unit vectors (k, 3) in the world of image points (k, 2) of cameras (k, 4, 4) with intrinsics (k, 8).

    The distortion is taken back by fixed-point iteration, which converges for every lens whose distortion is
    monotonous over the picture; where it does not, the ray is only as good as its last step.
    """
    goal = (xy_px - intrinsics[:, 2:4]) / intrinsics[:, :2]
    ideal = goal.copy()
    for _ in range(ROUNDS):
        step = goal - distort(ideal, intrinsics[:, 4:])
        ideal = ideal + np.clip(step, -0.3, 0.3)
        if np.abs(step).max(initial=0.0) < 1e-12:
            break
    direction = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(np.einsum("kij,kj->ki", world_from_cam[:, :3, :3], direction))


def convergence(direction: Floats, point: Ints, count: int) -> Floats:
    """Return how far the rays of each point are from parallel, (count,), from 0 to 2/3.

    The smallest eigenvalue of the mean of I - d dᵀ over unit directions (k, 3): a quarter of the squared angle between
    two rays.
    """
    _, normal = _normals(direction, point, count)
    return np.asarray(np.linalg.eigvalsh(normal)[:, 0] / np.maximum(np.bincount(point, minlength=count), 1))


def _normals(direction: Floats, point: Ints, count: int) -> tuple[Floats, Floats]:
    """Return I - d dᵀ of every ray (k, 3, 3) and their sums by point (count, 3, 3)."""
    projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    normal = np.zeros((count, 3, 3))
    for i in range(3):
        for j in range(3):
            normal[:, i, j] = np.bincount(point, projector[:, i, j], count)
    return projector, normal


def intersect(origin: Floats, direction: Floats, point: Ints, count: int) -> tuple[Floats, Bools]:
    """Return the points (count, 3) with the least sum of squared distances to their rays, and which are determined.

    Args:
        origin, direction: (k, 3) of the rays, directions of unit length.  point: (k,) point of each ray.

    Points with fewer than two rays, or with parallel ones (within some 0.1 degrees), are not determined.
    """
    projector, normal = _normals(direction, point, count)
    right = np.einsum("kij,kj->ki", projector, origin)
    rhs = np.stack([np.bincount(point, right[:, i], count) for i in range(3)], axis=1)
    determined = convergence(direction, point, count) > 1e-6
    found = np.linalg.solve(np.where(determined[:, None, None], normal, np.eye(3)), rhs[:, :, None])[:, :, 0]
    return np.asarray(found, dtype=np.float64), determined
