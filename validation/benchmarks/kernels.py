"""The kernels' benchmark: n = 30 images, m = 200 object points, P = 200 networks; tours of 20 and 30 stations."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from python_tsp.heuristics import solve_tsp_local_search

from netdesign.model.compiled import entry
from netdesign.model.frames import look_at, sphere_directions
from netdesign.motion.tour import nearest_neighbour_3opt, open_path
from netdesign.photogrammetry.limited_error import blocked
from netdesign.placement.evaluation import (
    SphereTables,
    precision_objective,
    variances_from_moments,
    write_direction,
    write_moments,
)

NETWORKS, IMAGES, POINTS, RADIUS, FOCAL, SIGMA = 200, 30, 200, 0.6, 3600.0, 0.1
CELLS = 5000  # rows of visibility bits to draw from
TEXTBOOK = 10  # networks of the slow side


@entry()
def _ours(viewpoints, cells, tables, out):
    blocks = len(tables.points) // 48
    directions, four = np.zeros((viewpoints.shape[1], 3)), np.zeros((4, 3))
    weights, moments, variances = np.zeros(blocks * 64), np.zeros(blocks * 144), np.zeros(blocks * 48)
    for p in range(len(viewpoints)):
        for i in range(viewpoints.shape[1]):
            write_direction(viewpoints[p, i, 0], viewpoints[p, i, 1], directions[i])
        write_moments(viewpoints[p], directions, cells[p], tables, weights, four, moments)
        variances_from_moments(moments, tables.points, tables.radius, tables.point_count, variances)
        out[p] = precision_objective(variances, tables)


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
            criterion=0, in_joints=False, longest=np.inf, limits=np.zeros(4),
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
            poses = look_at(RADIUS * sphere_directions(self.viewpoints[p]), np.zeros(3))
            camera = np.einsum("nji,nmj->nmi", poses[:, :3, :3], self.points[None] - poses[:, None, :3, 3])
            x, y, z = camera[..., 0], camera[..., 1], camera[..., 2]
            zero = np.zeros_like(z)
            local = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=-2)
            jacobian = FOCAL * np.einsum("nmrk,njk->nmrj", local, poses[:, :3, :3])
            jacobian = jacobian * self.seen[self.cells[p]][..., None, None]
            normal = np.einsum("nmri,nmrj->mij", jacobian, jacobian) / SIGMA**2
            out[p] = np.trace(np.linalg.inv(normal), axis1=1, axis2=2).sum() / (3 * POINTS)
        return out


def tours(n: int, cpu: Callable, ratio: Callable, repeats: int) -> Iterator[str]:
    """Yield lines on tours over n stations of a hemisphere: speed and mean gap."""
    rng = np.random.default_rng(n)
    matrices = []
    for _ in range(20):
        u = rng.normal(size=(n, 3))
        u[:, 2] = np.abs(u[:, 2])
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        matrices.append(np.linalg.norm(u[:, None] - u[None], axis=2))
    padded = [np.pad(matrix, ((1, 0), (1, 0))) for matrix in matrices[:3]]
    fast = cpu(lambda: [nearest_neighbour_3opt(matrix) for matrix in matrices], repeats)
    slow = cpu(lambda: [solve_tsp_local_search(matrix) for matrix in padded], repeats)
    per_tour = len(matrices) / len(padded)
    yield f"tours, n = {n}, against python-tsp's 2-opt search (>= 500)  {ratio([t * per_tour for t in slow], fast)}"
    best = np.array([open_path(matrix)[1] for matrix in matrices])
    ours = np.array([nearest_neighbour_3opt(matrix)[1] for matrix in matrices]) / best - 1
    theirs = np.array([solve_tsp_local_search(matrix)[1] for matrix in padded]) / best[: len(padded)] - 1
    yield f"    mean gap to iterated local search: ours {100 * ours.mean():.2f} %, theirs {100 * theirs.mean():.2f} %"
