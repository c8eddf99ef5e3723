"""The kernels' benchmark: n = 30 images, m = 200 object points, P = 200 networks; tours of 20 and 30 stations."""

import ctypes
import random
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from python_tsp.heuristics import solve_tsp_local_search

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import entry
from netdesign.model.frames import look_at, sphere_directions
from netdesign.motion.tour import nearest_neighbour_3opt, open_path
from netdesign.photogrammetry.limited_error import LANES, ROWS, blocked
from netdesign.placement.blocks import network_blocks, precision_objective
from netdesign.placement.evaluation import write_direction
from netdesign.placement.tables import SphereTables
from validation.benchmarks.table import Row

NETWORKS, IMAGES, POINTS, RADIUS, FOCAL, SIGMA = 200, 30, 200, 0.6, 3600.0, 0.1
CELLS = 5000  # rows of visibility bits to draw from
TEXTBOOK = 10  # networks of the slow side


@entry()
def _ours(viewpoints, cells, tables, out):
    blocks, slots = len(tables.points) // (3 * LANES), viewpoints.shape[1]
    directions, rows = np.zeros((slots, 3)), np.zeros(slots, np.int64)
    block, values, moments = np.zeros(ROWS * LANES), np.zeros(blocks), np.zeros(0)
    for p in range(len(viewpoints)):
        for i in range(slots):
            write_direction(viewpoints[p, i, 0], viewpoints[p, i, 1], directions[i])
        network_blocks(viewpoints[p], directions, cells[p], rows, tables, block, values, moments)
        out[p] = precision_objective(values, tables)


class Sides:
    """The same networks for the kernel, for C and for numpy."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(0)
        tags = POINTS // 4
        self.points = rng.uniform(-0.1, 0.1, (POINTS, 3))
        words = -(-tags // 64)
        seen = rng.random((CELLS, tags)) < 0.34
        seen[:, :] |= (np.arange(tags)[None] % 7) == (np.arange(CELLS)[:, None] % 7)
        packed = np.packbits(np.pad(seen, ((0, 0), (0, 64 * words - tags))), axis=1, bitorder="little")
        bits = np.ascontiguousarray(packed).view(np.uint64)
        self.viewpoints = np.stack(
            [rng.uniform(-np.pi, np.pi, (NETWORKS, IMAGES)), rng.uniform(0.2, 1.5, (NETWORKS, IMAGES))], axis=2
        )
        self.cells = rng.integers(0, CELLS, (NETWORKS, IMAGES))
        self.tables = SphereTables(
            points=blocked(self.points.T), point_count=POINTS, tags=tags, radius=RADIUS, grid=np.zeros(6), sure=bits,
            weight=np.ones((1, POINTS + -POINTS % 16)), weight_grid=np.zeros(6),
            variance=(SIGMA / FOCAL) ** 2, min_rays=2, min_tags=1,
            criterion=0, longest=np.inf, limits=np.zeros(4),
        )  # fmt: skip
        self.seen, self.out = np.repeat(seen, 4, axis=1), np.zeros(NETWORKS)
        self.textbook_share = NETWORKS / TEXTBOOK
        self.has_c = shutil.which("gcc") is not None
        self.flat = np.ascontiguousarray(self.points.T)
        self.rows = np.ascontiguousarray(bits[self.cells])
        if self.has_c:
            library = folder / "limited_reference.so"
            source = Path(__file__).with_name("limited_reference.c")
            command = [
                "gcc",
                "-O3",
                "-march=native",
                "-ffast-math",
                "-shared",
                "-fPIC",
                str(source),
                "-o",
                str(library),
            ]
            subprocess.run(command, check=True)
            self._c = ctypes.CDLL(str(library)).sum_of_traces
            np.testing.assert_allclose(self.c(), self.ours(), rtol=1e-9)
        np.testing.assert_allclose(self.textbook(), self.ours()[:TEXTBOOK], rtol=1e-9)

    def ours(self) -> np.ndarray:
        """Return f1 of all networks by the search's kernel, from viewpoints and cells."""
        _ours(self.viewpoints, self.cells, self.tables, self.out)
        return self.out.copy()

    def c(self) -> np.ndarray:
        """Return f1 of all networks by C; it gets sines and cosines from numpy."""
        directions, out = np.ascontiguousarray(sphere_directions(self.viewpoints)), np.zeros(NETWORKS)
        address = [array.ctypes.data_as(ctypes.c_void_p) for array in (self.flat, directions, self.rows, out)]
        sizes = [ctypes.c_long(value) for value in (NETWORKS, IMAGES, POINTS, self.rows.shape[-1])]
        self._c(*sizes, ctypes.c_double(RADIUS), *address)
        return out * self.tables.variance / (3 * POINTS)

    def textbook(self) -> np.ndarray:
        """Return f1 of the first networks by numpy broadcasting: Jacobians, sums, inverses."""
        out = np.zeros(TEXTBOOK)
        for p in range(TEXTBOOK):
            seen = self.seen[self.cells[p]]
            mean = mean_variance_by_numpy(RADIUS * sphere_directions(self.viewpoints[p]), self.points, seen)
            out[p] = mean * self.tables.variance
        return out


def mean_variance_by_numpy(centres: Floats, points: Floats, visible: Bools) -> float:
    """Return f1 of cameras at centres (n, 3) that look at the origin: unit focal length and sigma.

    Args:
        points: (m, 3).  visible: (n, m).
    """
    poses = look_at(centres, np.zeros(3))
    camera = np.einsum("nji,nmj->nmi", poses[:, :3, :3], points[None] - poses[:, None, :3, 3])
    x, y, z = camera[..., 0], camera[..., 1], camera[..., 2]
    zero = np.zeros_like(z)
    local = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=-2)
    jacobian = np.einsum("nmrk,njk->nmrj", local, poses[:, :3, :3]) * visible[..., None, None]
    normal = np.einsum("nmri,nmrj->mij", jacobian, jacobian)
    return float(np.trace(np.linalg.inv(normal), axis1=1, axis2=2).sum() / (3 * len(points)))


def tours(n: int, repeats: int) -> Iterator[Row]:
    """Yield rows on tours over n stations of a hemisphere: speed and mean gap, both sides on the same instances."""
    matrices = _hemispheres(n, 20)
    padded = [np.pad(matrix, ((1, 0), (1, 0))) for matrix in matrices]
    ratios, theirs = [], []
    nearest_neighbour_3opt(matrices[0])
    for repeat in range(repeats):
        random.seed(repeat)  # python-tsp starts anywhere
        start = time.process_time()
        theirs.append([solve_tsp_local_search(matrix)[1] for matrix in padded])
        middle = time.process_time()
        for _ in range(50):
            ours = [nearest_neighbour_3opt(matrix)[1] for matrix in matrices]
        ratios.append(50 * (middle - start) / (time.process_time() - middle))
    best = np.array([open_path(matrix)[1] for matrix in matrices])
    gap, other = (np.array(ours) / best - 1).mean(), (np.array(theirs) / best - 1).mean()
    yield Row(f"tours, n = {n}, against python-tsp's 2-opt search", 500.0, ratios)
    yield Row(f"tours, n = {n}: mean gap of python-tsp over ours", 1.0, [float(other / gap)], f"ours {100 * gap:.2f} %")


def small_tours() -> Iterator[Row]:
    """Yield how many reported tours up to twelve images are as short as dynamic programming says."""
    exact = []
    for n in range(2, 13):
        for matrix in _hemispheres(n, 5):
            order, length = open_path(matrix)
            walked = matrix[order[:-1], order[1:]].sum()
            exact.append(float(max(walked, length) <= subsets(matrix) * (1 + 1e-12)))
    yield Row("reported tours up to 12 images without a gap, share", 1.0, [float(np.mean(exact))])


def subsets(distance: np.ndarray) -> float:
    """Return the length of the shortest open path by dynamic programming over subsets, in numpy: not our kernel."""
    n = len(distance)
    shortest = np.full((1 << n, n), np.inf)
    shortest[1 << np.arange(n), np.arange(n)] = 0.0
    for subset in range(1, 1 << n):
        ends = shortest[subset]
        for following in range(n):
            if not subset >> following & 1:
                longer = (ends + distance[:, following]).min()
                shortest[subset | 1 << following, following] = min(shortest[subset | 1 << following, following], longer)
    return float(shortest[-1].min())


def _hemispheres(n: int, count: int) -> list[np.ndarray]:
    """Chords between n random directions with z >= 0."""
    rng = np.random.default_rng(n)
    matrices = []
    for _ in range(count):
        u = rng.normal(size=(n, 3))
        u[:, 2] = np.abs(u[:, 2])
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        matrices.append(np.linalg.norm(u[:, None] - u[None], axis=2))
    return matrices
