"""Occlusion for a whole neighbourhood of camera positions at once: a cone of lines of sight against the mesh.

The cone has its apex at an object point and contains all the camera positions in question. Both answers are proofs.

* ``cone_is_free``: no triangle meets the cone, so no line of sight in it is blocked.
* ``cone_is_covered``: a connected patch of the mesh, all of it facing the apex the same way, cuts every line of sight.
  The patch grows from one triangle on the axis across every edge that meets the cone. Seen from the apex each
  neighbour lies on the other side of the shared edge (same facing, consistent winding), so a path of directions that
  starts on the axis cannot leave the patch without leaving the cone.
"""

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import part
from netdesign.photogrammetry.bvh import TriangleTree

# Added to the sine of the half angle: more than the exact test's barycentric slack and rounding.
ANGLE_SLACK = 1e-6
LARGEST_PATCH = 256

Corner = tuple[float, float, float]
Corners = tuple[Corner, Corner, Corner]


def neighbours(tree: TriangleTree) -> Ints:
    """Return (t, 3): the row of the triangle across edge k (corner k to k + 1), -1 where there is none.

    Corners are the same when their coordinates are equal. Only a triangle that runs along the edge in the opposite
    direction counts: one with consistent winding.
    """
    count = len(tree.triangles)
    corners = np.repeat(tree.triangles[:, None, :3], 3, axis=1)
    corners[:, 1:] += tree.triangles[:, 3:].reshape(-1, 2, 3)
    scale = 1e-9 * max(float(np.abs(corners).max(initial=0.0)), 1e-9)
    _, vertex = np.unique(np.round(corners.reshape(-1, 3) / scale), axis=0, return_inverse=True)
    start = vertex.reshape(count, 3)
    end = np.roll(start, -1, axis=1)
    forward, backward = (start * (3 * count) + end).ravel(), (end * (3 * count) + start).ravel()
    order = np.argsort(forward, kind="stable")
    place = np.minimum(np.searchsorted(forward[order], backward), max(3 * count - 1, 0))
    found = forward[order][place] == backward
    return np.ascontiguousarray(np.where(found, order[place] // 3, -1).reshape(count, 3))


@part()
def cone_is_free(
    px: float, py: float, pz: float, axis: Floats, distance: float, spread: float, normal: Floats, clearance: float,
    bounds: Floats, starts: Ints, triangles: Floats,
) -> bool:  # fmt: skip
    """Tell whether no triangle meets the lines from p to the positions within ``spread`` of p + distance · axis.

    Args:
        px, py, pz: apex, m.  axis: (3,) unit.  distance, spread: m.
        normal: (3,) of the tag's plane; triangles that rise less than ``clearance`` above it do not count.
        bounds, starts, triangles: of a TriangleTree.
    """
    if len(triangles) == 0:
        return True
    sine = spread / distance + ANGLE_SLACK
    if sine >= 0.99:
        return False
    cosine = np.sqrt(1.0 - sine * sine)
    dx, dy, dz = axis[0], axis[1], axis[2]
    nx, ny, nz = normal[0], normal[1], normal[2]
    first_leaf = len(starts) - 1
    node = 1
    while node > 0:
        hx = 0.5 * (bounds[node, 3] - bounds[node, 0])
        hy = 0.5 * (bounds[node, 4] - bounds[node, 1])
        hz = 0.5 * (bounds[node, 5] - bounds[node, 2])
        vx, vy, vz = bounds[node, 0] + hx - px, bounds[node, 1] + hy - py, bounds[node, 2] + hz - pz
        along = vx * dx + vy * dy + vz * dz
        across = np.sqrt(max(vx * vx + vy * vy + vz * vz - along * along, 0.0))
        radius = np.sqrt(hx * hx + hy * hy + hz * hz)
        height = vx * nx + vy * ny + vz * nz + hx * abs(nx) + hy * abs(ny) + hz * abs(nz)
        if (
            height > clearance
            and across * cosine - along * sine <= radius
            and along + radius >= 0.0
            and along - radius <= distance + spread
        ):
            if node < first_leaf:
                node *= 2
                continue
            leaf = node - first_leaf
            for k in range(starts[leaf], starts[leaf + 1]):
                corners, highest, _ = _seen_from(triangles[k], px, py, pz, nx, ny, nz)
                if highest > clearance and _meets(corners, dx, dy, dz, sine, cosine):
                    return False
        while node & 1:
            node >>= 1
        node |= 1 if node else 0
    return True


@part()
def cone_is_covered(
    first: int, px: float, py: float, pz: float, axis: Floats, distance: float, spread: float, normal: Floats,
    clearance: float, least_cosine: float, triangles: Floats, across: Ints, visited: Ints, queue: Ints,
) -> bool:  # fmt: skip
    """Tell whether the mesh around triangle ``first``, which the axis hits, provably cuts every line of the cone.

    Args:
        least_cosine: cosine of the steepest incidence that matters.  across: of ``neighbours``.
        visited: (t + 1,) stamps, the last one the number of calls so far.  queue: (LARGEST_PATCH,) work space.
        Others: as in ``cone_is_free``.
    """
    sine = spread / distance + ANGLE_SLACK
    if sine >= 0.99:
        return False
    cosine = np.sqrt(1.0 - sine * sine)
    dx, dy, dz = axis[0], axis[1], axis[2]
    stamp = visited[-1] + 1
    visited[-1] = stamp
    queue[0], visited[first] = first, stamp
    done, count, facing = 0, 1, 0.0
    while done < count:
        row = queue[done]
        done += 1
        corners, _, farthest = _seen_from(triangles[row], px, py, pz, normal[0], normal[1], normal[2])
        plane = _plane_distance(triangles[row], corners)
        if done == 1:
            facing = 1.0 if plane > 0.0 else -1.0
        # In front of every camera position, above the clearance, and not edge-on.
        if farthest > distance - spread or plane * facing * least_cosine <= 2.0 * clearance:
            return False
        for k in range(3):
            if _edge_meets(corners, k, dx, dy, dz, sine, cosine):
                other = across[row, k]
                if other < 0:
                    return False
                if visited[other] != stamp:
                    if count == LARGEST_PATCH:
                        return False
                    visited[other] = stamp
                    queue[count] = other
                    count += 1
    return True


@part()
def _seen_from(
    triangle: Floats, px: float, py: float, pz: float, nx: float, ny: float, nz: float
) -> tuple[Corners, float, float]:
    """Corners (three tuples) relative to the apex, their largest height above the plane, their largest distance."""
    ax, ay, az = triangle[0] - px, triangle[1] - py, triangle[2] - pz
    bx, by, bz = ax + triangle[3], ay + triangle[4], az + triangle[5]
    cx, cy, cz = ax + triangle[6], ay + triangle[7], az + triangle[8]
    highest = max(
        ax * nx + ay * ny + az * nz,
        max(bx * nx + by * ny + bz * nz, cx * nx + cy * ny + cz * nz),
    )
    farthest = np.sqrt(max(ax * ax + ay * ay + az * az, max(bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz)))
    return ((ax, ay, az), (bx, by, bz), (cx, cy, cz)), highest, farthest


@part()
def _plane_distance(triangle: Floats, corners: Corners) -> float:
    """Signed distance of the triangle's plane from the apex; 0 for a degenerate triangle."""
    ax, ay, az = triangle[3], triangle[4], triangle[5]
    bx, by, bz = triangle[6], triangle[7], triangle[8]
    mx, my, mz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    area = np.sqrt(mx * mx + my * my + mz * mz)
    if area == 0.0:
        return 0.0
    return float((corners[0][0] * mx + corners[0][1] * my + corners[0][2] * mz) / area)


@part()
def _meets(corners: Corners, dx: float, dy: float, dz: float, sine: float, cosine: float) -> bool:
    """Tell whether the triangle meets the infinite cone: the axis hits it, or an edge comes near enough."""
    inside = True
    for k in range(3):
        if _edge_meets(corners, k, dx, dy, dz, sine, cosine):
            return True
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
        mx, my, mz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        # Within the triangle's own cone when on the third corner's side of every edge; edge-on there is no inside.
        if (mx * dx + my * dy + mz * dz) * (mx * cx + my * cy + mz * cz) <= 0.0:
            inside = False
    return inside


@part()
def _edge_meets(corners: Corners, k: int, dx: float, dy: float, dz: float, sine: float, cosine: float) -> bool:
    """Tell whether edge k comes within the cone: angular distance of the axis from an arc of directions."""
    ax, ay, az = corners[k]
    bx, by, bz = corners[(k + 1) % 3]
    if ax * dx + ay * dy + az * dz >= cosine * np.sqrt(ax * ax + ay * ay + az * az):
        return True
    if bx * dx + by * dy + bz * dz >= cosine * np.sqrt(bx * bx + by * by + bz * bz):
        return True
    mx, my, mz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    gap = mx * dx + my * dy + mz * dz
    size = mx * mx + my * my + mz * mz
    # On the edge's own line the arc has shrunk to its ends.
    in_line = size <= 1e-24 * (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)
    if in_line or gap * gap > sine * sine * size:
        return False
    from_a = (my * az - mz * ay) * dx + (mz * ax - mx * az) * dy + (mx * ay - my * ax) * dz
    to_b = (by * mz - bz * my) * dx + (bz * mx - bx * mz) * dy + (bx * my - by * mx) * dz
    return bool(from_a >= 0.0 and to_b >= 0.0)
