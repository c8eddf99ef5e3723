"""Local search around networks, compiled: cameras nudged, moved, taken away or added, computed by differences.

From a member of the archive, under one weighting of log f1 against log f2, single-camera moves are tried one after the
other and kept when the weighted sum falls. f1 comes from the moments minus the old camera plus the new one; in the
workspace f2 comes from taking the station out of the tour and putting it back where it costs least, repaired by 3-opt
only when that brings the move within reach. Every network tried is written out, for the archive to judge.

With motion in joints the workspace tour only guides the moves; f2 of what was tried is then computed in joints.
"""

import math
from typing import NamedTuple

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import entry, part
from netdesign.motion.three_opt import improve
from netdesign.photogrammetry.limited_error import LANES, ROWS, add_two_cameras, block_variances
from netdesign.placement.blocks import (
    KEPT,
    largest_variance,
    load_moments,
    network_blocks,
    precision_objective,
    save_moments,
    seen_tags,
    weigh,
    weight_row,
    write_points,
    write_seen,
)
from netdesign.placement.evaluation import excess, missing_sightings, write_direction
from netdesign.placement.tables import MAX_SIGMA, SphereTables
from netdesign.placement.visibility_map import cell_index

PROMISING = 0.05  # of the weighted logarithms: a move this near to an improvement gets its tour repaired
MOVE, REMOVE, ADD = 0, 1, 2


class Tries(NamedTuple):
    """What is tried on each of B members, drawn outside: C candidates each.

    Attributes:
        kind: (B, C) MOVE, REMOVE or ADD.
        camera: (B, C) which camera moves or goes.
        viewpoint: (B, C, 2) where it goes, rad; NaN for a step from where it is.
        step: (B, C, 2) bearing from east to north and length of the step, rad.
        preference: (B,) weight of log f1 in [0, 1], the rest is log f2's.
    """

    kind: Ints
    camera: Ints
    viewpoint: Floats
    step: Floats
    preference: Floats


@part(allocates=False)
def write_step(viewpoint: Floats, direction: Floats, step: Floats, limits: Floats, moved: Floats) -> None:
    """Write the viewpoint (2,) after a step (bearing, length) along the sphere, folded into ``limits`` (4,)."""
    east_x, east_y = -math.sin(viewpoint[0]), math.cos(viewpoint[0])
    sine, up = math.sin(step[1]), math.cos(step[1])
    east, north = math.cos(step[0]) * sine, math.sin(step[0]) * sine
    x = up * direction[0] + east * east_x - north * direction[2] * east_y
    y = up * direction[1] + east * east_y + north * direction[2] * east_x
    z = up * direction[2] + north * (direction[0] * east_y - direction[1] * east_x)
    middle = 0.5 * (limits[0] + limits[1])
    alpha = middle + (math.atan2(y, x) - middle + np.pi) % (2.0 * np.pi) - np.pi
    moved[0] = min(max(alpha, limits[0]), limits[1])
    moved[1] = min(max(math.atan2(z, math.sqrt(x * x + y * y)), limits[2]), limits[3])


@part(allocates=False)
def write_chords(directions: Floats, k: int, a: int, D: Floats) -> None:
    """Write the chords from station ``a`` to the ``k`` stations with unit directions; station i is node i + 1."""
    for b in range(k):
        square = 0.0
        for axis in range(3):
            square += (directions[a, axis] - directions[b, axis]) ** 2
        D[a + 1, b + 1] = D[b + 1, a + 1] = math.sqrt(square)


@part(allocates=False)
def reinserted(D: Floats, t: Ints, count: int, gone: int, new: int, moved: Floats, out: Ints) -> float:
    """Write the closed tour t (count,) without node ``gone``, and with ``new`` where it costs least; return its length.

    ``gone`` = -1 takes nothing out, ``new`` = -1 puts nothing in; ``moved`` (N,) distances of ``new`` to the nodes.
    """
    left = 0
    for x in range(count):
        if t[x] != gone:
            out[left] = t[x]
            left += 1
    length, best, where = 0.0, np.inf, 0
    for x in range(left):
        a, b = out[x], out[x + 1 if x + 1 < left else 0]
        length += D[a, b]
        more = moved[a] + moved[b] - D[a, b]
        if more < best:
            best, where = more, x
    if new < 0:
        return length
    for x in range(left, where + 1, -1):
        out[x] = out[x - 1]
    out[where + 1] = new
    return length + best


@entry(nogil=True)
def improve_networks(
    viewpoints: Floats, sizes: Ints, tries: Tries, tables: SphereTables,
    found: Floats, counts: Ints, objectives: Floats, violation: Floats,
) -> None:  # fmt: skip
    """Try what ``tries`` says on B feasible networks, improving them on the way; write every network tried.

    Args:
        viewpoints: (B, n, 2), of which the first ``sizes`` (B,) are used; changed in place.
        found: (B, C, n, 2), counts: (B, C), objectives: (B, C, 2), violation: (B, C): the networks tried.
    """
    members, slots = viewpoints.shape[0], viewpoints.shape[1]
    blocks = len(tables.points) // (3 * LANES)
    now, then = np.zeros((slots + 1, 3)), np.zeros((slots + 1, 3))  # directions
    cells, new_cells = np.zeros(slots + 1, np.int64), np.zeros(slots + 1, np.int64)
    rows, block = np.zeros(slots + 1, np.int64), np.zeros(ROWS * LANES)
    values, new_values, touched = np.zeros(blocks), np.zeros(blocks), np.zeros(blocks, np.bool_)
    moments, changed = np.zeros(blocks * KEPT), np.zeros(blocks * KEPT)
    at_least = np.zeros((tables.min_rays, tables.sure.shape[1]), np.uint64)
    sure, weight, points, radius, count = tables.sure, tables.weight, tables.points, tables.radius, tables.point_count
    worst, varies = tables.criterion == MAX_SIGMA, len(tables.weight) > 1
    D, trial_D = np.zeros((slots + 2, slots + 2)), np.zeros((slots + 2, slots + 2))
    P = np.zeros((slots + 2, slots + 3))
    t, trial = np.zeros(slots + 2, np.int64), np.zeros(slots + 2, np.int64)
    for b in range(members):
        here, k = viewpoints[b], sizes[b]
        for i in range(k):
            write_direction(here[i, 0], here[i, 1], now[i])
            cells[i] = cell_index(here[i, 0], here[i, 1], tables.grid)
        network_blocks(here[:k], now, cells, rows, tables, block, values, moments)
        f1 = precision_objective(values, tables)
        for i in range(k):
            write_chords(now, k, i, D)
        for x in range(k + 1):
            t[x] = x
        f2 = tables.radius * improve(D, t[: k + 1], P)
        w = tries.preference[b]
        value = w * math.log(f1) + (1.0 - w) * math.log(f2 + 1e-9)
        for c in range(tries.kind.shape[1]):
            kind = tries.kind[b, c]
            i = k if kind == ADD else tables.fixed + tries.camera[b, c] % max(k - tables.fixed, 1)
            size = k + 1 if kind == ADD else (k - 1 if kind == REMOVE else k)
            violation[b, c], counts[b, c] = np.inf, 0
            if size > slots or size < 2 or (kind != ADD and k == tables.fixed):
                continue
            there = found[b, c]
            for x in range(k):
                there[x, 0], there[x, 1], new_cells[x] = here[x, 0], here[x, 1], cells[x]
                then[x, 0], then[x, 1], then[x, 2] = now[x, 0], now[x, 1], now[x, 2]
            if kind == REMOVE:  # the last station takes the place of the one that goes
                there[i, 0], there[i, 1], new_cells[i] = here[k - 1, 0], here[k - 1, 1], cells[k - 1]
                then[i, 0], then[i, 1], then[i, 2] = now[k - 1, 0], now[k - 1, 1], now[k - 1, 2]
            else:
                if math.isnan(tries.viewpoint[b, c, 0]):
                    write_step(here[i % k], now[i % k], tries.step[b, c], tables.limits, there[i])
                else:
                    there[i, 0], there[i, 1] = tries.viewpoint[b, c, 0], tries.viewpoint[b, c, 1]
                write_direction(there[i, 0], there[i, 1], then[i])
                new_cells[i] = cell_index(there[i, 0], there[i, 1], tables.grid)
            counts[b, c] = size
            lacking = missing_sightings(new_cells[:size], tables, at_least)
            if lacking > 0:
                violation[b, c] = 1.0 + lacking
                continue
            new_cell, new_row = np.int64(-1), 0
            if kind != REMOVE:
                new_cell, new_row = new_cells[i], weight_row(there[i, 0], there[i, 1], tables)
            weak = 0
            for index in range(blocks):
                coming = np.uint64(0) if kind == REMOVE else seen_tags(new_cell, index, sure)
                going = np.uint64(0) if kind == ADD else seen_tags(cells[i], index, sure)
                new_values[index] = values[index]
                touched[index] = (coming | going) != np.uint64(0)
                if not touched[index]:
                    continue
                write_points(index, points, block)
                load_moments(index, moments, block)
                write_seen(coming, 0, block)
                write_seen(going, 1, block)
                if varies:
                    weigh(index, new_row, 0, weight, block)
                    weigh(index, rows[i] if kind != ADD else 0, 1, weight, block)
                add_two_cameras(
                    block, then[i, 0], then[i, 1], then[i, 2], now[i, 0], now[i, 1], now[i, 2], radius, 1.0, -1.0
                )
                total, lost = block_variances(block, radius, count - index * LANES)
                new_values[index] = largest_variance(block) if worst else total
                weak += lost
                save_moments(index, block, changed)
            if weak > 0:
                violation[b, c] = weak
                continue
            new_f1 = precision_objective(new_values, tables)
            if kind == REMOVE:
                length = reinserted(D, t, k + 1, i + 1, -1, D[0], trial)
            else:
                write_chords(then, size, i, trial_D)
                gone = i + 1 if kind == MOVE else -1
                length = reinserted(D, t, k + 1, gone, i + 1, trial_D[i + 1], trial)
            new_f2 = tables.radius * length
            near = w * math.log(new_f1) + (1.0 - w) * math.log(new_f2 + 1e-9) < value + PROMISING
            if kind == MOVE and near:
                for x in range(1, k + 1):
                    for y in range(1, k + 1):
                        if x != i + 1 and y != i + 1:
                            trial_D[x, y] = D[x, y]
                new_f2 = tables.radius * improve(trial_D, trial[: k + 1], P)
            objectives[b, c, 0], objectives[b, c, 1] = new_f1, new_f2
            violation[b, c] = excess(new_f2, tables.longest)
            new_value = w * math.log(new_f1) + (1.0 - w) * math.log(new_f2 + 1e-9)
            if kind != MOVE or violation[b, c] > 0 or new_value >= value:
                continue
            value = new_value
            here[i, 0], here[i, 1], cells[i] = there[i, 0], there[i, 1], new_cells[i]
            now[i, 0], now[i, 1], now[i, 2] = then[i, 0], then[i, 1], then[i, 2]
            rows[i] = new_row
            for index in range(blocks):
                if touched[index]:
                    values[index] = new_values[index]
                    load_moments(index, changed, block)
                    save_moments(index, block, moments)
            write_chords(now, k, i, D)
            for x in range(k + 1):
                t[x] = trial[x]
