"""Visibility over whole cells of the viewing sphere, decided with proof (kernels of ``visibility_map``).

Every test of ``photogrammetry.visibility`` is made at the middle of a cell and then for the cell's worst viewpoint.
With delta the largest angle between a viewing direction of the cell and its middle, w the distance of an object point
from the sphere's centre and R the radius:

* the camera moves by at most 2 R sin(delta / 2), a point's depth R - u·p changes by at most 2 w sin(delta / 2);
* the camera turns by at most kappa·delta. kappa = 1 / cos(theta / 2) for the fixed roll of ``frames.look_at``, theta
  the largest polar angle on the way: u turns by delta, and the frame spins about it by tan(theta / 2) times that;
  kappa = 1 when the roll is free, because only roll-free measures are then used;
* so a point moves in the camera frame by at most rho = 2 w sin(kappa·delta / 2), and its normalised image point q by at
  most rho sqrt(1 + q²) / z, z its least depth; distortion stretches that by at most its largest gain;
* an edge of length s changes in normalised coordinates by at most kappa·delta S s / z (1 + 2 w / z), S² = 1 + q²:
  the derivatives of its two ends, subtracted before they are bounded.

A cell may also be deep: its stations then stand within e of R from the centre, camera positions and depths change by e
more, an image point by at most q e / z more (q' = -q / z) and an edge by at most (1 + q) e / z of itself.
"""

import math

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry, part
from netdesign.photogrammetry.bvh import blocking_triangle
from netdesign.photogrammetry.occlusion import cone_is_covered, cone_is_free

HIDDEN, UNDECIDED, VISIBLE = 0, 1, 2

Words = NDArray[np.uint64]
# bounds, starts, triangles, neighbours; then work space: stamps (t + 1,), queue (LARGEST_PATCH,).
Mesh = tuple[Floats, Ints, Floats, Ints, Ints, Ints]


@part(allocates=False)
def stretches(radius: float, settings: Floats) -> tuple[float, float]:
    """Return the least and the largest stretch of a short or long edge by the distortion, within a normalised radius.

    The distortion's Jacobian is symmetric with the eigenvalues 1 + 3 k1 s + 5 k2 s² along the radius and
    1 + k1 s + k2 s² across, s = r², but for a tangential part of at most 6.4 (|p1| + |p2|) r. Integrated along an edge,
    the least eigenvalue bounds the length of its image from below.
    """
    square = radius * radius
    least = most = 1.0
    for along in range(2):
        linear, quadratic = settings[4] * (3.0 if along else 1.0), settings[5] * (5.0 if along else 1.0)
        end = 1.0 + square * (linear + square * quadratic)
        least, most = min(least, end), max(most, end)
        if quadratic != 0.0 and 0.0 < -linear / (2.0 * quadratic) < square:
            turn = 1.0 - linear * linear / (4.0 * quadratic)
            least, most = min(least, turn), max(most, turn)
    tangential = 6.4 * (abs(settings[6]) + abs(settings[7])) * radius
    return max(least - tangential, 0.0), most + tangential


@part()
def classify(
    pose: Floats, radius: float, half_depth: float, delta: float, turn: float, points: Floats, away: Floats,
    normal: Floats, settings: Floats, field: Floats, tag_size: float,
) -> int:  # fmt: skip
    """Return HIDDEN, UNDECIDED or VISIBLE, but for occlusion, of one tag from every viewpoint of a cell.

    Args:
        pose: (4, 4) world_from_cam in the middle of the cell.  radius: R.  half_depth: e, m.  delta: rad.
        turn: kappa·delta, rad.
        points: (5, 3) of the tag.  away: (5,) their distances from the sphere's centre.  normal: (3,).
        settings: of ``visibility.sight_settings``.  field: of ``visibility_map.field_bounds``.
    """
    moved = 2.0 * radius * math.sin(0.5 * delta) + half_depth
    sin_limit = math.sqrt(max(1.0 - settings[12] ** 2, 0.0))
    everywhere = True
    nearest, widest, farthest_out = np.inf, 0.0, 0.0
    image = np.empty((4, 2))
    for k in range(4):
        dx, dy, dz = points[k, 0] - pose[0, 3], points[k, 1] - pose[1, 3], points[k, 2] - pose[2, 3]
        z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
        depth_change = 2.0 * away[k] * math.sin(0.5 * delta) + half_depth
        if z + depth_change <= 0.0 or z + depth_change < settings[14] or z - depth_change > settings[15]:
            return HIDDEN
        if z - depth_change < settings[14] or z + depth_change > settings[15]:
            everywhere = False
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        sine = moved / distance
        if sine >= 1.0 or z - depth_change <= 0.0:
            return UNDECIDED
        cosine = math.sqrt(1.0 - sine * sine)
        seen_at = -(dx * normal[0] + dy * normal[1] + dz * normal[2]) / distance
        if seen_at < settings[12] * cosine - sin_limit * sine - 1e-12:
            return HIDDEN
        if sine >= sin_limit or seen_at < settings[12] * cosine + sin_limit * sine + 1e-12:
            everywhere = False
        nearest = min(nearest, z - depth_change)
        image[k, 0] = (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / z
        image[k, 1] = (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / z
        widest = max(widest, image[k, 0] ** 2 + image[k, 1] ** 2)
        farthest_out = max(farthest_out, away[k])
    # The worst of the four corners stands for all of them.
    stretch = math.sqrt(1.0 + widest)
    turned = 2.0 * farthest_out * math.sin(0.5 * min(turn, np.pi)) * stretch / nearest
    approach = half_depth / nearest
    shift = turned + (math.sqrt(widest) + turned) * approach
    reach = field[1] + shift
    square = reach * reach
    tangential = abs(settings[6]) + abs(settings[7])
    bend = 3.0 * abs(settings[4]) * square + 5.0 * abs(settings[5]) * square * square + 6.4 * tangential * reach
    curve = 6.0 * abs(settings[4]) * reach + 20.0 * abs(settings[5]) * reach * square + 6.4 * tangential
    focal_high, focal_low = max(settings[0], settings[1]), min(settings[0], settings[1])
    aside = math.sqrt(widest) + shift
    stretch = math.sqrt(1.0 + aside**2)
    edge = stretch * tag_size / nearest
    edge_change = turn * edge * (1.0 + 2.0 * farthest_out / nearest) + (1.0 + aside) * approach * edge
    drift = turn * stretch * farthest_out / nearest + aside * approach
    shortest_low, shortest_high = np.inf, np.inf
    free_roll = field[2] > 0.0
    least, most = stretches(aside, settings)
    margin = focal_high * (1.0 + bend) * shift + 1e-9
    u = v = first_u = first_v = last_u = last_v = 0.0
    for k in range(4):
        x, y = image[k, 0], image[k, 1]
        s = x * x + y * y
        r = math.sqrt(s)
        if r - shift > field[1]:
            return HIDDEN
        if free_roll:
            if r + shift > field[0]:
                everywhere = False
            x0, y0 = image[k - 1, 0], image[k - 1, 1]
            length = math.sqrt((x - x0) ** 2 + (y - y0) ** 2)
            shortest_low = min(shortest_low, focal_low * least * (length - edge_change))
            shortest_high = min(shortest_high, focal_high * most * (length + edge_change))
            continue
        if s > settings[17]:
            return UNDECIDED
        radial = 1.0 + s * (settings[4] + s * settings[5])
        p1, p2 = settings[6], settings[7]
        u = settings[0] * (x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)) + settings[2]
        v = settings[1] * (y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y) + settings[3]
        low, high = min(u - settings[8], v - settings[10]), max(u - settings[9], v - settings[11])
        if low < -margin or high > margin:
            return HIDDEN
        if low < margin or high > -margin or (r + shift) ** 2 > settings[17]:
            everywhere = False
        change = focal_high * ((1.0 + bend) * edge_change + curve * edge * drift)
        if k == 0:
            first_u, first_v = u, v
        else:
            length = math.sqrt((u - last_u) ** 2 + (v - last_v) ** 2)
            shortest_low, shortest_high = min(shortest_low, length - change), min(shortest_high, length + change)
        if k == 3:
            length = math.sqrt((u - first_u) ** 2 + (v - first_v) ** 2)
            shortest_low, shortest_high = min(shortest_low, length - change), min(shortest_high, length + change)
        last_u, last_v = u, v
    if shortest_high < settings[13] - 1e-9:
        return HIDDEN
    if shortest_low < settings[13] + 1e-9:
        everywhere = False
    return VISIBLE if everywhere else UNDECIDED


@part()
def shadow(
    state: int, pose: Floats, spread: float, points: Floats, normal: Floats, settings: Floats, mesh: Mesh
) -> int:  # fmt: skip
    """Return ``state`` of a tag and a cell after occlusion for camera positions within ``spread`` of the pose."""
    bounds, starts, triangles, across, visited, queue = mesh
    axis = np.empty(3)
    for trial in range(2):
        for k in range(4, -1, -1):
            dx, dy, dz = pose[0, 3] - points[k, 0], pose[1, 3] - points[k, 1], pose[2, 3] - points[k, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            height = dx * normal[0] + dy * normal[1] + dz * normal[2]
            if height <= settings[16] or distance <= spread:
                return UNDECIDED
            axis[0], axis[1], axis[2] = dx / distance, dy / distance, dz / distance
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            if trial == 0:
                share = settings[16] / height
                hit = blocking_triangle(
                    x + share * dx, y + share * dy, z + share * dz, (1.0 - share) * dx, (1.0 - share) * dy,
                    (1.0 - share) * dz, bounds, starts, triangles,
                )  # fmt: skip
                if hit >= 0:
                    if cone_is_covered(
                        hit, x, y, z, axis, distance, spread, normal, settings[16], settings[12], triangles, across,
                        visited, queue,
                    ):  # fmt: skip
                        return HIDDEN
                    state = UNDECIDED
            elif not cone_is_free(x, y, z, axis, distance, spread, normal, settings[16], bounds, starts, triangles):
                return UNDECIDED
        if state != VISIBLE:
            break
    return state


@entry()
def fill(
    level: Ints, shape: Ints, poses: Floats, angles: Floats, radius: float, points: Floats, away: Floats,
    normals: Floats, shadowed: Bools, settings: Floats, field: Floats, tag_size: float, mesh: Mesh | None,
    waiting: Bools, sure: Words, maybe: Words,
) -> None:  # fmt: skip
    """Decide the tags that wait at the blocks of one level of the quadtree; set their bits, or pass them down.

    Args:
        level: (3,) cells along the edge of a block, rows and columns of blocks.  shape: (2,) rows, columns of cells.
        poses: (blocks, 4, 4) world_from_cam in the middle of each block.  angles: (blocks, 2) delta and kappa·delta.
        shadowed: (g,) whether any part of the mesh rises above the tag's plane.
        mesh: bounds, starts and triangles of a TriangleTree, their ``neighbours``, work space; None when nothing is
            shadowed, and then the tests of occlusion are not even compiled.
        waiting: (blocks, g) undecided so far; on return those to be decided at the next level.
        sure, maybe: (cells, words), changed in place.
        Others: as in ``classify`` and ``occlusion``.
    """
    size, block_columns = level[0], level[2]
    for block in range(len(poses)):
        first_row, first_column = (block // block_columns) * size, (block % block_columns) * size
        delta, turn = angles[block, 0], angles[block, 1]
        for g in range(len(points)):
            if not waiting[block, g]:
                continue
            state = classify(
                poses[block], radius, 0.0, delta, turn, points[g], away[g], normals[g], settings, field, tag_size
            )
            if mesh is not None and shadowed[g] and (state == VISIBLE or (state == UNDECIDED and size == 1)):
                spread = 2.0 * radius * math.sin(0.5 * delta)
                state = shadow(state, poses[block], spread, points[g], normals[g], settings, mesh)
            waiting[block, g] = state == UNDECIDED and size > 1
            if state == HIDDEN or waiting[block, g]:
                continue
            bits = sure if state == VISIBLE else maybe
            for row in range(first_row, min(first_row + size, shape[0])):
                for column in range(first_column, min(first_column + size, shape[1])):
                    bits[row * shape[1] + column, g >> 6] |= np.uint64(1) << np.uint64(g & 63)


@entry()
def settle(
    poses: Floats, radii: Floats, half_depths: Floats, angles: Floats, points: Floats, away: Floats, normals: Floats,
    shadowed: Bools, settings: Floats, field: Floats, tag_size: float, mesh: Mesh | None, sure: Words, maybe: Words,
) -> None:  # fmt: skip
    """Decide, as far as the size of each cell allows, the tags that may be seen from it.

    Args:
        poses: (c, 4, 4) in the middle of each cell.  radii, half_depths: (c,) m.  angles: (c, 2) delta, kappa·delta.
        sure, maybe: (c, words), changed in place: only bits of ``maybe`` are looked at.
        Others: as in ``fill``.
    """
    for cell in range(len(poses)):
        delta, turn = angles[cell, 0], angles[cell, 1]
        for g in range(len(points)):
            bit = np.uint64(1) << np.uint64(g & 63)
            if not maybe[cell, g >> 6] & bit:
                continue
            state = classify(
                poses[cell], radii[cell], half_depths[cell], delta, turn, points[g], away[g], normals[g], settings,
                field, tag_size,
            )  # fmt: skip
            if mesh is not None and shadowed[g] and state != HIDDEN:
                spread = 2.0 * radii[cell] * math.sin(0.5 * delta) + half_depths[cell]
                state = shadow(state, poses[cell], spread, points[g], normals[g], settings, mesh)
            if state != UNDECIDED:
                maybe[cell, g >> 6] ^= bit
            if state == VISIBLE:
                sure[cell, g >> 6] |= bit
