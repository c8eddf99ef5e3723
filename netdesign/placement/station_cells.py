"""The admissible stations in cells of direction and distance, each with the tags that it may see; cut where it matters.

A cell is a range of azimuth, elevation and distance from the centre. Its distances are cut down to what the body of
admissible stations has in these directions, its tags to those that cannot be excluded (``visibility_cells``); a cell
without either is dropped. What is dropped holds no admissible station that sees anything: the proof of ``bound``.
"""

from dataclasses import dataclass, replace

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import Task
from netdesign.photogrammetry.bvh import TriangleTree
from netdesign.photogrammetry.occlusion import LARGEST_PATCH, neighbours
from netdesign.photogrammetry.visibility import shadowed, sight_points, sight_settings
from netdesign.placement.visibility_cells import Words, settle
from netdesign.placement.visibility_map import field_bounds, spread_angle

COARSEST = np.radians(12.0)  # largest width of a cell at the start


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Cells of stations.

    Attributes:
        middle, half: (c, 3) azimuth rad, elevation rad, distance m; and half their ranges.
        sure, maybe: (c, words) uint64; bit g % 64 of word g // 64: tag g is seen from all of the cell; is not excluded.
    """

    middle: Floats
    half: Floats
    sure: Words
    maybe: Words

    def __len__(self) -> int:
        return len(self.middle)

    @property
    def directions(self) -> Floats:
        """(c, 3) unit vectors to the middle."""
        return sphere_directions(self.middle)

    @property
    def deltas(self) -> Floats:
        """(c,) largest angle of a direction from the middle, rad."""
        return spread_angle(self.middle[:, 1], self.half[:, 0], self.half[:, 1]) + 1e-12

    @property
    def depths(self) -> Floats:
        """(c, 2) least and largest distance, m."""
        return np.stack([self.middle[:, 2] - self.half[:, 2], self.middle[:, 2] + self.half[:, 2]], axis=1)

    @property
    def possible(self) -> Words:
        """(c, words) tags that some station of the cell may see."""
        return self.sure | self.maybe

    def within(self, angle: float) -> Bools:
        """(c,) whether the cell lies within an angle about its middle, as seen from the centre."""
        return (self.deltas <= angle) & (self.half[:, 2] <= angle * self.middle[:, 2])

    @property
    def points(self) -> "Cells":
        """Their middles, as if these saw all the tags that some station of the cell may see."""
        return Cells(middle=self.middle, half=np.zeros_like(self.half), sure=self.possible, maybe=self.maybe * 0)

    def take(self, rows: Bools | Ints | slice) -> "Cells":
        """Return the cells of ``rows``."""
        return Cells(middle=self.middle[rows], half=self.half[rows], sure=self.sure[rows], maybe=self.maybe[rows])

    def joined(self, other: "Cells") -> "Cells":
        """Return these cells and the others."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("middle", "half", "sure", "maybe"))
        return Cells(**dict(zip(("middle", "half", "sure", "maybe"), map(np.concatenate, pairs), strict=True)))


class StationCells:
    """The cells of a study's admissible stations: the first ones and their parts."""

    def __init__(self, task: Task) -> None:
        scene, camera, limits, sphere = task.scene, task.camera, task.limits, task.sphere
        mesh = scene.part.triangles if limits.occlusion else np.zeros((0, 3, 3))
        self.sphere, self.tag_count, self.tag_size = sphere, len(scene.targets.ids), scene.targets.size_m
        self.points, self.settings = sight_points(scene.targets), sight_settings(camera, limits, scene.targets.size_m)
        self.away = np.linalg.norm(self.points - sphere.centre, axis=2)
        self.normals = np.ascontiguousarray(scene.targets.normals)
        self.field = field_bounds(camera, limits, sphere.roll is None)
        self.shadowed = shadowed(mesh, self.points, self.normals, self.settings[16])
        tree = TriangleTree.build(mesh if self.shadowed.any() else mesh[:0])
        space = (np.zeros(len(mesh) + 1, np.int64), np.empty(LARGEST_PATCH, np.int64))
        arrays = (tree.bounds, tree.starts, tree.triangles, neighbours(tree), *space)
        self.mesh = arrays if len(tree.triangles) else None

    def first(self) -> Cells:
        """Return cells that cover every admissible station which sees anything."""
        axes = []
        for low, high in (self.sphere.azimuth, self.sphere.elevation):
            count = max(1, int(np.ceil((high - low) / COARSEST - 1e-9)))
            axes.append(((high - low) / count * (np.arange(count) + 0.5) + low, 0.5 * (high - low) / count))
        (alpha, half_alpha), (beta, half_beta) = axes
        near, far = reach(self.sphere)
        count = len(alpha) * len(beta)
        columns = [np.tile(alpha, len(beta)), np.repeat(beta, len(alpha)), np.full(count, (near + far) / 2)]
        middle = np.column_stack(columns)
        half = np.tile([half_alpha, half_beta, (far - near) / 2], (count, 1))
        every = self.words(np.ones(self.tag_count, np.bool_), count)
        return self._settled(Cells(middle=middle, half=half, sure=np.zeros_like(every), maybe=every))

    def parts(self, cells: Cells, axis: Ints) -> Cells:
        """Return what is left of both halves of each cell, cut along ``axis`` (c,): 0, 1 or 2."""
        half, rows = cells.half.copy(), np.arange(len(cells))
        half[rows, axis] *= 0.5
        step = np.zeros_like(half)
        step[rows, axis] = half[rows, axis]
        both = [replace(cells, middle=cells.middle + sign * step, half=half) for sign in (-1.0, 1.0)]
        return self._settled(both[0].joined(both[1]))

    def words(self, tags: Bools, count: int) -> Words:
        """Return (count, words) rows of the tags (g,)."""
        bits = np.zeros((count, -(-self.tag_count // 64)), np.uint64)
        for tag in np.flatnonzero(tags).tolist():
            bits[:, tag // 64] |= np.uint64(1) << np.uint64(tag % 64)
        return bits

    def stations(self, places: Floats, tags: Words) -> Cells:
        """Return stations at places (s, 3), azimuth, elevation and distance, as cells without width.

        Their ``sure`` are those of ``tags`` (s, words) that they see; of a free roll every tag that some roll sees.
        """
        field = self.field if self.sphere.roll is not None else np.array([self.field[1], self.field[1], 1.0])
        found = Cells(middle=places, half=np.zeros_like(places), sure=np.zeros_like(tags), maybe=tags.copy())
        self._settle(found, field)
        return replace(found, maybe=np.zeros_like(tags))

    def samples(self, cells: Cells) -> Cells:
        """Return stations in the middle of cells, also at their nearest and farthest admissible distance."""
        ends, there = [cells.middle[:, 2]], np.ones(len(cells), np.bool_)
        if self.sphere.depth is not None:
            least, largest = self.sphere.depth.limits(cells.directions)
            there = (least <= largest) & (least > 0.0)  # a box may hold the centre itself
            ends = [np.clip(end, least, np.maximum(least, largest)) for end in (*cells.depths.T, cells.middle[:, 2])]
        places = np.concatenate([np.column_stack([cells.middle[there, :2], end[there]]) for end in ends])
        return self.stations(places, np.tile(cells.possible[there], (len(ends), 1)))

    def _settled(self, cells: Cells) -> Cells:
        """Cells cut down to the admissible distances, their tags decided as far as possible; the empty ones dropped."""
        if self.sphere.depth is not None:
            depths, deltas = cells.depths, cells.deltas
            near, far = self.sphere.depth.limits_around(cells.directions, 2.0 * np.sin(0.5 * deltas))
            # A trifle more, for rounding.
            near, far = np.maximum(depths[:, 0], near * (1 - 1e-12)), np.minimum(depths[:, 1], far * (1 + 1e-12))
            there = near <= far
            middle, half = cells.middle.copy(), cells.half.copy()
            middle[:, 2], half[:, 2] = 0.5 * (near + far), 0.5 * np.maximum(far - near, 0.0)
            cells = replace(cells, middle=middle, half=half).take(there)
        cells = replace(cells, sure=cells.sure.copy(), maybe=cells.maybe.copy())
        self._settle(cells, self.field)
        return cells.take((cells.possible != 0).any(axis=1))

    def _settle(self, cells: Cells, field: Floats) -> None:
        """Decide the tags that the cells may see, in place."""
        delta = cells.deltas
        polar = np.minimum(0.5 * np.pi - cells.middle[:, 1] + delta, np.pi)
        turn = delta if self.sphere.roll is None else delta / np.maximum(np.cos(0.5 * polar), 1e-9)
        settle(
            self._poses(cells), np.ascontiguousarray(cells.middle[:, 2]), np.ascontiguousarray(cells.half[:, 2]),
            np.stack([delta, turn], axis=1), self.points, self.away, self.normals, self.shadowed, self.settings,
            field, self.tag_size, self.mesh, cells.sure, cells.maybe,
        )  # fmt: skip

    def _poses(self, cells: Cells) -> Floats:
        """Return world_from_cam (c, 4, 4) in the middle of the cells."""
        position = self.sphere.centre + cells.middle[:, 2:] * cells.directions
        return look_at(position, self.sphere.centre, self.sphere.roll or 0.0)


def reach(sphere: ViewingSphere) -> tuple[float, float]:
    """Return bounds of the distances of all admissible stations from the centre, m."""
    if sphere.depth is None:
        return sphere.radius, sphere.radius
    near, far = sphere.depth.limits_around(np.array([0.0, 0.0, 1.0]), np.array(2.0))
    return float(near), float(far)
