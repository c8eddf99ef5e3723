"""Which tags are seen from which cell of the viewing sphere: one row of bits per cell, three-valued and proved.

``sure`` bits: the tag is seen from every viewpoint of the cell. ``maybe`` bits: the cell's size does not allow a
decision. No bit: the tag is seen from nowhere in the cell. The proofs are in ``visibility_cells``; a search on sure
bits is therefore conservative, and sure or maybe together cover every sighting that exists (which ``bound`` needs).
"""

import contextlib
import hashlib
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.compiled import part
from netdesign.model.scene import Scene
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import VisibilityLimits
from netdesign.photogrammetry.bvh import TriangleTree
from netdesign.photogrammetry.occlusion import LARGEST_PATCH, neighbours
from netdesign.photogrammetry.visibility import monotone_radius_squared, shadowed, sight_points, sight_settings
from netdesign.placement.visibility_cells import Words, fill

VERSION = 2  # of the kernels: part of the key of the cache
COARSEST = 16  # cells along the edge of a block of the coarsest level


@dataclass(frozen=True, kw_only=True)
class VisibilityMap:
    """Bit rows over the tags for every cell of (alpha, beta); cell = row · columns + column.

    Attributes:
        sure, maybe: (cells, words) uint64; bit g % 64 of word g // 64 is tag g. Disjoint.
        tag_count: g.
        grid: (6,) lowest azimuth, cells per rad, columns; lowest elevation, cells per rad, rows.
        free_roll: sure holds for every roll, and sure or maybe covers every roll.
    """

    sure: Words
    maybe: Words
    tag_count: int
    grid: Floats
    free_roll: bool

    @staticmethod
    def build(
        scene: Scene, camera: Camera, sphere: ViewingSphere, limits: VisibilityLimits, step: float = np.radians(0.5)
    ) -> "VisibilityMap":
        """Return the map with cells of at most ``step`` rad; from the user's cache when the same was built before.

        Costs about a second for 50 tags; everything that goes in is part of the cache's key.
        """
        points, settings = sight_points(scene.targets), sight_settings(camera, limits, scene.targets.size_m)
        normals, field = np.ascontiguousarray(scene.targets.normals), field_bounds(camera, limits, sphere.roll is None)
        mesh = scene.part.triangles if limits.occlusion else np.zeros((0, 3, 3))
        grid = _grid(sphere, step)
        roll = sphere.roll or 0.0
        station = np.array([*sphere.centre, sphere.radius, roll, scene.targets.size_m])
        path = _cache_path(points, normals, settings, field, mesh, grid, station)
        rows_of_bits = _read(path)
        if rows_of_bits is None:
            above = shadowed(mesh, points, normals, settings[16])
            rows_of_bits = _decide(
                sphere, grid, mesh if above.any() else mesh[:0], above, points, normals, settings, field
            )
            _write(path, rows_of_bits)
        sure, maybe = rows_of_bits
        return VisibilityMap(sure=sure, maybe=maybe, tag_count=len(points), grid=grid, free_roll=sphere.roll is None)

    @property
    def rows(self) -> int:
        """Number of steps in elevation."""
        return int(self.grid[5])

    @property
    def columns(self) -> int:
        """Number of steps in azimuth."""
        return int(self.grid[2])

    @property
    def words(self) -> int:
        """Number of 64-bit words per cell."""
        return int(self.sure.shape[1])

    @property
    def half_steps(self) -> tuple[float, float]:
        """Half the size of a cell in azimuth and elevation, rad."""
        return float(0.5 / self.grid[1]), float(0.5 / self.grid[4])

    @property
    def centres(self) -> Floats:
        """(cells, 2) alpha, beta in the middle of every cell, rad."""
        alpha = self.grid[0] + (np.arange(self.columns) + 0.5) / self.grid[1]
        beta = self.grid[3] + (np.arange(self.rows) + 0.5) / self.grid[4]
        return np.stack([np.tile(alpha, self.rows), np.repeat(beta, self.columns)], axis=1)

    @property
    def solid_angles(self) -> Floats:
        """(cells,) share of the admissible part of the sphere, sum 1."""
        edges = np.sin(self.grid[3] + np.arange(self.rows + 1) / self.grid[4])
        return np.repeat(np.diff(edges) / (edges[-1] - edges[0]) / self.columns, self.columns)

    def cell_of(self, viewpoints: Floats) -> Ints:
        """Return (…) the cells of viewpoints (…, 2) = (alpha, beta) rad; outside the range the nearest ones."""
        flat = np.ascontiguousarray(viewpoints, np.float64).reshape(-1, 2)
        cells = np.array([cell_index(alpha, beta, self.grid) for alpha, beta in flat], dtype=np.int64)
        return cells.reshape(viewpoints.shape[:-1])

    def sure_tags(self, cells: Ints) -> Bools:
        """Return (k, g): tag g is seen from every viewpoint of cell k."""
        return unpacked(self.sure[cells], self.tag_count)

    def possible_tags(self, cells: Ints) -> Bools:
        """Return (k, g): tag g is seen, or the map cannot exclude it, from some viewpoint of cell k."""
        return unpacked(self.sure[cells] | self.maybe[cells], self.tag_count)


@part(allocates=False)
def cell_index(alpha: float, beta: float, grid: Floats) -> int:
    """Return the cell of a viewpoint; the azimuth wraps, what lies outside goes to the nearest row or column."""
    turn = 2.0 * np.pi
    from_low = (alpha - grid[0]) % turn
    column = int(from_low * grid[1])
    if column >= grid[2]:
        # Beyond the high end: nearer to it, or to the low end from the other side?
        past = from_low - grid[2] / grid[1]
        column = int(grid[2]) - 1 if past <= turn - from_low else 0
    row = int(np.floor((beta - grid[3]) * grid[4]))
    row = min(max(row, 0), int(grid[5]) - 1)
    return row * int(grid[2]) + column


def field_bounds(camera: Camera, limits: VisibilityLimits, free_roll: bool) -> Floats:
    """Return (3,): normalised undistorted radii and 1.0 when the roll is free, else 0.0.

    Whatever the roll, every direction within the first radius is in the frame less the border, none beyond the second.
    The radial polynomial is bracketed by the largest tangential distortion, 3 (|p1| + |p2|) r².
    """
    fx, fy, cx, cy, k1, k2, p1, p2 = camera.intrinsics.tolist()
    low = limits.border_px - 0.5
    left, right = (cx - low) / fx, (camera.width_px - 1 - low - cx) / fx
    top, bottom = (cy - low) / fy, (camera.height_px - 1 - low - cy) / fy
    inner = max(min(left, right, top, bottom), 0.0)
    outer = float(np.hypot(max(abs(left), abs(right)), max(abs(top), abs(bottom))))
    fold = float(np.sqrt(monotone_radius_squared(camera)))
    if not any((k1, k2, p1, p2)):
        return np.array([inner, outer, float(free_roll)])
    radius = np.linspace(0.0, min(fold, 4.0 * outer), 20001)
    growth = radius * (1.0 + k1 * radius**2 + k2 * radius**4)
    tangential = 3.0 * (abs(p1) + abs(p2)) * radius**2
    inside = np.flatnonzero(np.maximum.accumulate(growth + tangential) <= inner)
    outside = np.flatnonzero(growth - tangential >= outer)
    largest = radius[outside[0]] if outside.size else fold
    return np.array([radius[inside[-1]] if inside.size else 0.0, largest, float(free_roll)])


def _grid(sphere: ViewingSphere, step: float) -> Floats:
    """Cells that fill the range exactly and are no larger than ``step``."""
    numbers = []
    for low, high in (sphere.azimuth, sphere.elevation):
        count = max(1, int(np.ceil((high - low) / step - 1e-9)))
        numbers += [low, count / (high - low), float(count)]
    return np.array(numbers)


def _decide(
    sphere: ViewingSphere, grid: Floats, mesh: Floats, above: Bools, points: Floats, normals: Floats, settings: Floats,
    field: Floats,
) -> Words:  # fmt: skip
    """(2, cells, words) sure and maybe: level by level from blocks of COARSEST cells to single cells."""
    rows, columns, free_roll = int(grid[5]), int(grid[2]), sphere.roll is None
    rows_of_bits = np.zeros((2, rows * columns, -(-len(points) // 64)), np.uint64)
    tree = TriangleTree.build(mesh)
    space = (np.zeros(len(mesh) + 1, np.int64), np.empty(LARGEST_PATCH, np.int64))
    surface = (tree.bounds, tree.starts, tree.triangles, neighbours(tree), *space) if len(mesh) else None
    tag_size = float(np.linalg.norm(points[0, 1] - points[0, 0]))
    waiting = np.ones((-(-rows // COARSEST) * -(-columns // COARSEST), len(points)), bool)
    size = COARSEST
    while True:
        across, along = -(-rows // size), -(-columns // size)
        row, column = np.arange(across) * size, np.arange(along) * size
        low, high = row, np.minimum(row + size, rows)
        left, right = column, np.minimum(column + size, columns)
        beta, half_beta = grid[3] + 0.5 * (low + high) / grid[4], 0.5 * (high - low) / grid[4]
        alpha, half_alpha = grid[0] + 0.5 * (left + right) / grid[1], 0.5 * (right - left) / grid[1]
        delta = spread_angle(beta[:, None], half_alpha[None], half_beta[:, None]) + 1e-12
        polar = np.minimum(0.5 * np.pi - beta[:, None] + delta, np.pi)
        turn = delta if free_roll else delta / np.maximum(np.cos(0.5 * polar), 1e-9)
        viewpoints = np.stack(np.broadcast_arrays(alpha[None], beta[:, None]), axis=-1).reshape(-1, 2)
        fill(
            np.array([size, across, along]), np.array([rows, columns]), sphere.cameras(viewpoints),
            np.stack([delta.ravel(), turn.ravel()], axis=1), float(sphere.radius), points,
            np.linalg.norm(points - sphere.centre, axis=2), normals, above, settings, field, tag_size, surface, waiting,
            rows_of_bits[0], rows_of_bits[1],
        )  # fmt: skip
        if size == 1:
            return rows_of_bits
        size //= 2
        # Each block hands what still waits to its four quarters (fewer at the upper edges of the grid).
        waiting = waiting.reshape(across, along, -1).repeat(2, axis=0).repeat(2, axis=1)
        waiting = np.ascontiguousarray(waiting[: -(-rows // size), : -(-columns // size)]).reshape(-1, len(points))


def spread_angle(beta: Floats, half_alpha: Floats, half_beta: Floats) -> Floats:
    """Return the largest angle between a direction in a cell and its middle, at elevation ``beta`` (haversine)."""
    low, high = beta - half_beta, beta + half_beta
    widest = np.where((low < 0.0) & (high > 0.0), 1.0, np.maximum(np.cos(low), np.cos(high)))
    square = np.sin(0.5 * half_beta) ** 2 + np.cos(beta) * widest * np.sin(0.5 * np.minimum(half_alpha, np.pi)) ** 2
    return np.asarray(2.0 * np.arcsin(np.minimum(np.sqrt(square), 1.0)))


def unpacked(rows: Words, count: int) -> Bools:
    """Return (…, count) the tags of rows of bits (…, words)."""
    bits = np.unpackbits(np.ascontiguousarray(rows).view(np.uint8), axis=-1, bitorder="little")
    return bits[..., :count].astype(bool)


def _cache_path(*arrays: Floats) -> Path:
    digest = hashlib.sha256(f"{VERSION} {COARSEST}".encode())
    for array in arrays:
        digest.update(str(array.shape).encode() + np.ascontiguousarray(array, np.float64).tobytes())
    root = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return root / "netdesign" / f"visibility-{digest.hexdigest()[:32]}.npz"


def _read(path: Path) -> Words | None:
    """The stored rows of bits, None when there are none (or only a damaged file)."""
    try:
        with np.load(path) as stored:
            return np.asarray(stored["bits"], dtype=np.uint64)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None


def _write(path: Path, rows_of_bits: Words) -> None:
    """Write beside the place, then rename; a cache that cannot be written is no cache."""
    beside = path.with_suffix(f".{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as scratch:
            np.savez_compressed(scratch, bits=rows_of_bits)
        beside.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink()
