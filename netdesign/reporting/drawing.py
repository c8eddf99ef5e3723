"""Orthographic drawings of a part, its tags, cameras and ellipsoids for static figures.

A parallel projection maps an ellipsoid of covariance C exactly to the ellipse of covariance A C Aᵀ, A (2, 3); the
painter's order needs no depth buffer for what is drawn here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.frames import transform
from netdesign.photogrammetry.bvh import TriangleTree
from netdesign.reporting.mesh import PartMesh, face_normals, hidden

EDGE_PIECES, TAG_PIECES = 8, 6


@dataclass(frozen=True, kw_only=True)
class View:
    """A direction of view: azimuth and elevation of the eye, rad."""

    azimuth: float
    elevation: float

    @property
    def axes(self) -> Floats:
        """(3, 3): right, up and towards the eye, as rows in the world frame."""
        ca, sa, ce, se = np.cos(self.azimuth), np.sin(self.azimuth), np.cos(self.elevation), np.sin(self.elevation)
        return np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])

    def flat(self, points: Floats) -> Floats:
        """Return (…, 2) drawing coordinates of points (…, 3)."""
        return np.asarray(points @ self.axes[:2].T)

    def nearness(self, points: Floats) -> Floats:
        """Return (…,) the distance towards the eye."""
        return np.asarray(points @ self.axes[2])


def draw_solids(axes: Axes, view: View, solids: Sequence[tuple[Floats, Ints, tuple[float, float, float]]]) -> None:
    """Draw several meshes (vertices, faces, colour) that may hide one another: all triangles in painter's order."""
    triangles = np.concatenate([vertices[faces] for vertices, faces, _ in solids])
    colors = np.concatenate([np.tile(color, (len(faces), 1)) for _, faces, color in solids])
    normals = np.concatenate([face_normals(vertices, faces) for vertices, faces, _ in solids])
    front = normals @ view.axes[2] > 1e-6
    order = np.argsort(view.nearness(triangles.mean(axis=1))[front], kind="stable")
    light = view.axes.T @ np.array([-0.35, 0.55, 0.76])
    shade = 0.72 + 0.28 * np.clip(normals[front][order] @ light, 0, 1)
    shaded = np.clip(colors[front][order] * shade[:, None], 0, 1)
    axes.add_collection(
        PolyCollection(list(view.flat(triangles[front][order])), facecolors=shaded, edgecolors=shaded, linewidths=0.3)
    )


def draw_part(axes: Axes, view: View, part: PartMesh) -> None:
    """Draw the triangles that face the eye, shaded, from back to front, and the feature edges that can be seen."""
    normals = face_normals(part.vertices, part.faces)
    front = normals @ view.axes[2] > 1e-6
    triangles = part.vertices[part.faces[front]]
    order = np.argsort(view.nearness(triangles.mean(axis=1)), kind="stable")
    light = view.axes.T @ np.array([-0.35, 0.55, 0.76])
    shade = 0.80 + 0.16 * np.clip(normals[front][order] @ light, 0, 1)
    colors = np.stack([shade, shade * 0.995, shade * 0.98, np.ones_like(shade)], axis=1)
    axes.add_collection(
        PolyCollection(list(view.flat(triangles[order])), facecolors=colors, edgecolors=colors, linewidths=0.4)
    )
    # An edge may be seen in part: a few pieces of it are judged one by one.
    ticks = np.linspace(0.0, 1.0, EDGE_PIECES + 1)[:, None]
    start, end = part.vertices[part.edges[:, 0], None], part.vertices[part.edges[:, 1], None]
    knots = start + ticks * (end - start)
    pieces = np.stack([knots[:, :-1], knots[:, 1:]], axis=2).reshape(-1, 2, 3)
    seen = ~hidden(part.tree, pieces.mean(axis=1), view.axes[2])
    axes.add_collection(
        LineCollection(list(view.flat(pieces[seen])), colors="#8a8a85", linewidths=0.6, capstyle="round")
    )


def draw_tags(axes: Axes, view: View, tree: TriangleTree, corners: Floats, normals: Floats, color: str) -> None:
    """Draw tags, corners (g, 4, 3) and normals (g, 3), as far as they face the eye and nothing hides them."""
    front = corners[normals @ view.axes[2] > 0.02]
    ticks = np.linspace(0.0, 1.0, TAG_PIECES + 1)
    u, v = (grid[..., None] for grid in np.meshgrid(ticks, ticks, indexing="ij"))
    a, b, c, d = (front[:, None, None, corner] for corner in range(4))
    knots = (1 - u) * ((1 - v) * a + v * d) + u * ((1 - v) * b + v * c)
    cells = np.stack([knots[:, :-1, :-1], knots[:, 1:, :-1], knots[:, 1:, 1:], knots[:, :-1, 1:]], axis=3)
    cells = cells.reshape(-1, 4, 3)
    seen = ~hidden(tree, cells.mean(axis=1), view.axes[2])
    # Not antialiased: neighbouring pieces would show their seams.
    axes.add_collection(
        PolyCollection(list(view.flat(cells[seen])), facecolors=[color], linewidths=0, antialiased=False)
    )


def frustum_lines(camera: Camera, world_from_cam: Floats, depth: float) -> Floats:
    """Return (n, 8, 2, 3) segments of the pyramids of view cut off at ``depth``: four rays, four image edges."""
    width, height = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    rays = np.ones((4, 3))
    rays[:, :2] = (corners - camera.principal_point_px) / camera.focal_px
    base = transform(world_from_cam[:, None], rays * depth)
    apex = np.broadcast_to(world_from_cam[:, None, :3, 3], base.shape)
    return np.concatenate([np.stack([apex, base], axis=2), np.stack([base, np.roll(base, -1, axis=1)], axis=2)], axis=1)


def draw_ellipsoids(
    axes: Axes, view: View, points: Floats, covariance: Floats, scale: float, color: str, keep: Bools
) -> None:
    """Draw the ellipsoids of covariances (m, 3, 3), semi-axes times ``scale``, at points (m, 3) where ``keep``."""
    projected = view.axes[:2] @ covariance[keep] @ view.axes[:2].T
    values, vectors = np.linalg.eigh(projected)
    sizes = 2.0 * scale * np.sqrt(np.maximum(values, 0.0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            sizes[:, 1], sizes[:, 0], angles, units="x", offsets=view.flat(points[keep]),
            offset_transform=axes.transData, facecolors=color + "33", edgecolors=color, linewidths=0.7,
        )
    )  # fmt: skip
