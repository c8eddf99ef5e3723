"""Capsules around collision meshes: a cover that is never smaller than the mesh, and quick to test.

A capsule is seven numbers, the ends of its segment and its radius. One is fitted by minimising its volume over the
line of its axis (direction and offset); a long link is cut across into slabs when two or three capsules are clearly
smaller than one.
"""

import itertools

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from netdesign.model.arrays import Floats, Ints

# Another capsule costs time in every test; it must save this share of the volume.
_WORTH_A_CAPSULE = 0.15


def fit_capsules(vertices: Floats, faces: Ints, most: int = 3) -> Floats:
    """Return capsules (k, 7), k <= most, in m: both segment ends and the radius; together they contain the mesh.

    Args:
        vertices: (v, 3) m.  faces: (t, 3).
    """
    best = _fit(vertices)[None]
    axis = best[0, 3:6] - best[0, :3]
    if np.linalg.norm(axis) < best[0, 6]:
        return best
    axis = axis / np.linalg.norm(axis)
    volume = _volume(best)
    for count in range(2, most + 1):
        cover = np.array([_fit(slab) for slab in _slabs(vertices[faces], axis, count)])
        if _volume(cover) < volume * (1.0 - _WORTH_A_CAPSULE):
            best, volume = cover, _volume(cover)
    return best


def _volume(capsules: Floats) -> float:
    length = np.linalg.norm(capsules[:, 3:6] - capsules[:, :3], axis=1)
    radius = capsules[:, 6]
    return float((np.pi * radius**2 * (length + 4.0 / 3.0 * radius)).sum())


def _slabs(triangles: Floats, axis: Floats, count: int) -> list[Floats]:
    """Return the points (v, 3) of the surface between equally spaced planes normal to the axis, cut edges included."""
    height = triangles @ axis
    cuts = np.linspace(height.min(), height.max(), count + 1)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    start, end = edges[:, 0] @ axis, edges[:, 1] @ axis
    slabs = []
    for low, high in itertools.pairwise(cuts.tolist()):
        inside = triangles.reshape(-1, 3)[((height >= low - 1e-9) & (height <= high + 1e-9)).reshape(-1)]
        pieces = [inside]
        for cut in (low, high):
            crossing = (start - cut) * (end - cut) < 0
            share = ((cut - start[crossing]) / (end - start)[crossing])[:, None]
            pieces.append(edges[crossing, 0] * (1.0 - share) + edges[crossing, 1] * share)
        slabs.append(np.concatenate(pieces))
    return slabs


def _fit(points: Floats) -> Floats:
    """Return the capsule (7,) of small volume that contains points (v, 3)."""
    points = np.unique(points, axis=0)
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:
        pass  # flat or too few points: all of them are taken
    centre = points.mean(axis=0)
    _, _, principal = np.linalg.svd(points - centre, full_matrices=False)
    best, best_volume = np.empty(7), np.inf
    for direction in principal:
        across = _across(direction)
        found = minimize(
            lambda x, d=direction, a=across: _volume(_on_line(points, centre, d, a, x)[None]),
            np.zeros(4), method="Nelder-Mead",
            options={"maxfev": 400, "initial_simplex": np.vstack([np.zeros(4), np.diag([0.1, 0.1, 0.01, 0.01])])},
        )  # fmt: skip
        if found.fun < best_volume:
            best, best_volume = _on_line(points, centre, direction, across, found.x), float(found.fun)
    return best


def _across(direction: Floats) -> Floats:
    """Return two unit vectors (2, 3) normal to a direction and to each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _on_line(points: Floats, centre: Floats, direction: Floats, across: Floats, x: Floats) -> Floats:
    """Return the smallest capsule about the line ``direction + x[:2]·across`` through ``centre + x[2:]·across``."""
    axis = direction + x[:2] @ across
    axis = axis / np.linalg.norm(axis)
    origin = centre + x[2:] @ across
    height = (points - origin) @ axis
    square = ((points - origin) ** 2).sum(axis=1) - height**2
    radius2 = float(square.max())
    slack = np.sqrt(np.maximum(radius2 - square, 0.0))
    # The lower end must lie at or below every height + slack, the upper end at or above every height - slack.
    low, high = float((height + slack).min()), float((height - slack).max())
    if low > high:
        low = high = 0.5 * (low + high)
    # 1 nm for rounding: a cover must not be smaller than what it covers.
    return np.concatenate([origin + low * axis, origin + high * axis, [np.sqrt(max(radius2, 0.0)) + 1e-9]])
