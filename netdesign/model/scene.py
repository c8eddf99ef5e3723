"""The part, the AprilTags on it, and the two together."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints, frozen

CORNERS_PER_TAG = 4


@dataclass(frozen=True, kw_only=True)
class Part:
    """A triangle mesh in the world frame, outward faces counter-clockwise.

    Attributes:
        vertices: (v, 3) m.  faces: (t, 3) vertex indices.
    """

    vertices: Floats
    faces: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", frozen("vertices", self.vertices, ("v", 3)))
        object.__setattr__(self, "faces", frozen("faces", self.faces, ("t", 3), np.int64))

    @property
    def triangles(self) -> Floats:
        """(t, 3, 3): corner coordinates of every face."""
        return self.vertices[self.faces]


class TagFamily(NamedTuple):
    """A family of AprilTags: cells along the black square, its border of one cell included, and how many ids."""

    cells: int
    ids: int


FAMILIES = {
    "tag16h5": TagFamily(cells=6, ids=30),
    "tag25h9": TagFamily(cells=7, ids=35),
    "tag36h10": TagFamily(cells=8, ids=2320),
    "tag36h11": TagFamily(cells=8, ids=587),
}


@dataclass(frozen=True, kw_only=True)
class Targets:
    """AprilTags in the world frame; their corners are the object points.

    Corner 0 to 3 of a tag: top-left, top-right, bottom-right, bottom-left of the black square as OpenCV draws it,
    seen from outside with the tag's x axis to the right. y of the tag frame points up: normal x x_axis.

    Attributes:
        ids: (g,) tag ids.  centres: (g, 3) m.  normals, x_axes: (g, 3) unit, orthogonal.
        size_m: edge of the black square.  family: one of ``FAMILIES``.
    """

    ids: Ints
    centres: Floats
    normals: Floats
    x_axes: Floats
    size_m: float
    family: str = "tag36h11"

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", frozen("ids", self.ids, ("g",), np.int64))
        count = len(self.ids)
        for name in ("centres", "normals", "x_axes"):
            object.__setattr__(self, name, frozen(name, getattr(self, name), (count, 3)))

    def take(self, rows: Bools) -> "Targets":
        """Return the tags chosen by ``rows`` (g,)."""
        kept = {name: getattr(self, name)[rows] for name in ("ids", "centres", "normals", "x_axes")}
        return replace(self, **kept)

    @property
    def cells(self) -> int:
        """Cells along the black square."""
        return FAMILIES[self.family].cells

    @property
    def points(self) -> Floats:
        """(m, 3) object points in m, m = 4 g, tag by tag, corner by corner."""
        half = 0.5 * self.size_m
        right = half * self.x_axes
        up = half * np.cross(self.normals, self.x_axes)
        corners = [self.centres - right + up, self.centres + right + up,
                   self.centres + right - up, self.centres - right - up]  # fmt: skip
        return np.stack(corners, axis=1).reshape(-1, 3)

    @property
    def point_normals(self) -> Floats:
        """(m, 3) outward unit normals of the object points."""
        return np.repeat(self.normals, CORNERS_PER_TAG, axis=0)

    @property
    def tag_of_point(self) -> Ints:
        """(m,) index of the tag (not its id) of every object point."""
        return np.repeat(np.arange(len(self.ids)), CORNERS_PER_TAG)

    @property
    def point_ids(self) -> tuple[str, ...]:
        """(m,) names "tag.corner"."""
        return tuple(f"{tag}.{corner}" for tag in self.ids.tolist() for corner in range(CORNERS_PER_TAG))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What stands in front of the camera: the part and its targets, both in the world frame."""

    part: Part
    targets: Targets
