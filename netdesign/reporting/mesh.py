"""The part as a report draws it: few enough triangles, and the edges that the eye looks for."""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.scene import Part
from netdesign.photogrammetry.bvh import TriangleTree


@dataclass(frozen=True, kw_only=True)
class PartMesh:
    """The part, ready to be drawn.

    Attributes:
        vertices: (v, 3) m.  faces: (t, 3).  edges: (e, 2) feature edges.  tree: over the same triangles.
    """

    vertices: Floats
    faces: Ints
    edges: Ints
    tree: TriangleTree

    @classmethod
    def of(cls, part: Part, limit: int) -> "PartMesh":
        """Return the part with at most ``limit`` triangles."""
        vertices, faces = light_mesh(part, limit)
        return cls(
            vertices=vertices,
            faces=faces,
            edges=feature_edges(vertices, faces),
            tree=TriangleTree.build(vertices[faces]),
        )


def hidden(tree: TriangleTree, points: Floats, towards: Floats) -> Bools:
    """Return (k,) whether a triangle stands between points (k, 3) and an eye far away in direction ``towards`` (3,).

    The points start a five-hundredth of the scene's size nearer to the eye, off the surface they lie on.
    """
    size = float(np.linalg.norm(tree.bounds[1, 3:] - tree.bounds[1, :3]))
    origins = points + 0.002 * size * towards
    return tree.blocked(origins, origins + 10.0 * size * towards)


def light_mesh(part: Part, limit: int) -> tuple[Floats, Ints]:
    """Return (vertices (v, 3), faces (t, 3)) with at most ``limit`` triangles.

    Vertices are snapped to a grid that is made coarser by a quarter until enough triangles have collapsed (vertex
    clustering, J. Rossignac and P. Borrel, 1993): crude, but it looks right at the size of a figure.
    """
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
    size = float(np.ptp(vertices, axis=0).max())
    cell = size / np.sqrt(8.0 * limit)
    while len(faces) > limit:
        _, first, label = np.unique(
            np.round((part.vertices - part.vertices.min(axis=0)) / cell), axis=0, return_index=True, return_inverse=True
        )
        vertices, faces = part.vertices[first], label.reshape(-1)[part.faces]
        whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[whole]
        faces = faces[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]]
        cell *= 1.25
    return vertices, faces


def feature_edges(vertices: Floats, faces: Ints, angle: float = 0.5) -> Ints:
    """Return (e, 2) vertex pairs of edges where the surface turns by more than ``angle`` rad, or ends."""
    merged, label = np.unique(vertices, axis=0, return_inverse=True)
    faces = label.reshape(-1)[faces]
    normals = face_normals(merged, faces)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    face = np.repeat(np.arange(len(faces)), 3)
    unique, inverse, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    first, last = face[order[start]], face[order[start + count - 1]]
    turn = np.einsum("ei,ei->e", normals[first], normals[last])
    kept = unique[(count != 2) | (turn < np.cos(angle))]
    return np.asarray(np.unique(vertices, axis=0, return_index=True)[1][kept], dtype=np.int64)


def face_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return (t, 3) unit normals of triangles; zero for one without an area."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))
