"""Which line of sight is blocked: any-hit queries of segments against a triangle mesh.

The tree is a complete binary tree in heap order (root 1, children 2i and 2i + 1), built level by level from median
splits of the triangle centroids. It needs no stack: after a miss or a leaf the walk goes on at the next node in
depth-first order, which the bits of the index give.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry, part

LEAF_SIZE = 4
# Barycentric slack: a ray through the edge that two triangles share must hit one of them.
EDGE_SLACK = 1e-9


@dataclass(frozen=True, kw_only=True)
class TriangleTree:
    """Triangles (two-sided) sorted into a bounding volume hierarchy.

    Attributes:
        bounds: (nodes, 6) m, lowest then highest coordinates of every node; row 0 is unused.
        starts: (leaves + 1,) leaf k holds triangles starts[k] to starts[k + 1].
        triangles: (t, 9) m: corner, first edge, second edge, in leaf order.
        order: (t,) index in the caller's array of every triangle.
    """

    bounds: Floats
    starts: Ints
    triangles: Floats
    order: Ints

    @staticmethod
    def build(corners: Floats) -> "TriangleTree":
        """Sort triangles (t, 3, 3); t may be 0 (nothing blocks)."""
        corners = np.asarray(corners, dtype=np.float64).reshape(-1, 3, 3)
        count = len(corners)
        levels = max(0, int(np.ceil(np.log2(max(count, 1) / LEAF_SIZE))))
        order = np.arange(count)
        centroids = corners.mean(axis=1)
        for level in range(levels):
            starts = _starts(count, level)
            node = np.repeat(np.arange(1 << level), np.diff(starts))
            spread = np.maximum.reduceat(centroids[order], starts[:-1]) - np.minimum.reduceat(
                centroids[order], starts[:-1]
            )
            along = centroids[order, spread.argmax(axis=1)[node]]
            order = order[np.lexsort((along, node))]
        sorted_corners = corners[order]
        bounds = np.zeros((2 << levels, 6))
        if count:
            # Flat boxes get a thickness, so that rounding in the slab test cannot lose them.
            padding = 1e-9 * max(float(np.abs(corners).max()), 1e-9)
            for level in range(levels + 1):
                starts, first = _starts(count, level), 1 << level
                bounds[first : 2 * first, :3] = np.minimum.reduceat(sorted_corners.min(axis=1), starts[:-1]) - padding
                bounds[first : 2 * first, 3:] = np.maximum.reduceat(sorted_corners.max(axis=1), starts[:-1]) + padding
        origin = sorted_corners[:, 0]
        edges = sorted_corners[:, 1] - origin, sorted_corners[:, 2] - origin
        triangles = np.ascontiguousarray(np.concatenate([origin, *edges], axis=1))
        return TriangleTree(bounds=bounds, starts=_starts(count, levels), triangles=triangles, order=order)

    def blocked(self, origins: Floats, ends: Floats) -> Bools:
        """Return (k,) whether a triangle meets the open segment from origins (k, 3) to ends (k, 3)."""
        origins, ends = np.ascontiguousarray(origins, np.float64), np.ascontiguousarray(ends, np.float64)
        blocked: Bools = _all_segments(origins, ends, self.bounds, self.starts, self.triangles)
        return blocked


def _starts(count: int, level: int) -> Ints:
    """First triangle of each of the 2^level nodes of a level, and the end: nearly equal shares."""
    parts = 1 << level
    return np.arange(parts + 1, dtype=np.int64) * count // parts


@part()
def blocking_triangle(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, bounds: Floats, starts: Ints, triangles: Floats
) -> int:
    """Return the row of a triangle that meets the segment o + t d, 0 < t < 1 (any, not the nearest), or -1.

    Triangle test: T. Möller, B. Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
    """
    if len(triangles) == 0:
        return -1
    tiny = 1e-200
    ix = 1.0 / (dx if abs(dx) > tiny else tiny)
    iy = 1.0 / (dy if abs(dy) > tiny else tiny)
    iz = 1.0 / (dz if abs(dz) > tiny else tiny)
    first_leaf = len(starts) - 1
    node = 1
    while node > 0:
        x0, x1 = (bounds[node, 0] - ox) * ix, (bounds[node, 3] - ox) * ix
        y0, y1 = (bounds[node, 1] - oy) * iy, (bounds[node, 4] - oy) * iy
        z0, z1 = (bounds[node, 2] - oz) * iz, (bounds[node, 5] - oz) * iz
        near = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
        far = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), 1.0))
        if near <= far:
            if node < first_leaf:
                node *= 2
                continue
            leaf = node - first_leaf
            for k in range(starts[leaf], starts[leaf + 1]):
                ax, ay, az = triangles[k, 3], triangles[k, 4], triangles[k, 5]
                bx, by, bz = triangles[k, 6], triangles[k, 7], triangles[k, 8]
                px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
                det = ax * px + ay * py + az * pz
                if det == 0.0:
                    continue
                inverse = 1.0 / det
                sx, sy, sz = ox - triangles[k, 0], oy - triangles[k, 1], oz - triangles[k, 2]
                u = (sx * px + sy * py + sz * pz) * inverse
                if u < -EDGE_SLACK or u > 1.0 + EDGE_SLACK:
                    continue
                qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
                v = (dx * qx + dy * qy + dz * qz) * inverse
                if v < -EDGE_SLACK or u + v > 1.0 + EDGE_SLACK:
                    continue
                t = (bx * qx + by * qy + bz * qz) * inverse
                if 0.0 < t < 1.0:
                    return k
        while node & 1:
            node >>= 1
        node |= 1 if node else 0
    return -1


@entry()
def _all_segments(origins: Floats, ends: Floats, bounds: Floats, starts: Ints, triangles: Floats) -> Bools:
    result = np.zeros(len(origins), np.bool_)
    for k in range(len(origins)):
        result[k] = 0 <= blocking_triangle(
            origins[k, 0], origins[k, 1], origins[k, 2],
            ends[k, 0] - origins[k, 0], ends[k, 1] - origins[k, 1], ends[k, 2] - origins[k, 2],
            bounds, starts, triangles,
        )  # fmt: skip
    return result
