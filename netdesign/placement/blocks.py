"""f1 of a network by limited error propagation, block by block, compiled.

A block is LANES object points, the corners of four tags. The images that see none of them are passed over: with tags
on every side of a part that is most of the work. All that a block needs lies in one small array.
"""

import math

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Floats, Ints
from netdesign.model.compiled import FAST, part
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.photogrammetry.limited_error import (
    LANES,
    MOMENTS,
    SPARE,
    VARIANCES,
    WEIGHT,
    add_two_cameras,
    block_variances,
)
from netdesign.placement.tables import MAX_SIGMA, SphereTables
from netdesign.placement.visibility_map import cell_index

FOUR_TAGS = np.repeat((np.arange(16)[:, None] >> np.arange(4)) & 1, CORNERS_PER_TAG, axis=1).ravel().astype(np.float64)
"""What four bits become: 1 for every corner of a tag that is seen, (16 x LANES,)."""

KEPT = (VARIANCES - MOMENTS) * LANES
"""Numbers that the moments of a block take."""


@part(allocates=False)
def write_points(index: int, points: Floats, block: Floats) -> None:
    """Write the points of a block (ROWS * LANES,) and set its moments to zero."""
    start = np.uint64(index) * np.uint64(3 * LANES)
    for row in range(3 * LANES):
        block[np.uint64(row)] = points[start + np.uint64(row)]
    for row in range(MOMENTS * LANES, VARIANCES * LANES):
        block[np.uint64(row)] = 0.0


@part(allocates=False)
def save_moments(index: int, block: Floats, moments: Floats) -> None:
    """Copy a block's moments to its place in ``moments`` (blocks * KEPT,)."""
    start, first = np.uint64(index * KEPT), np.uint64(MOMENTS * LANES)
    for row in range(KEPT):
        moments[start + np.uint64(row)] = block[first + np.uint64(row)]


@part(allocates=False)
def load_moments(index: int, moments: Floats, block: Floats) -> None:
    """Copy the moments of a block back from ``moments``."""
    start, first = np.uint64(index * KEPT), np.uint64(MOMENTS * LANES)
    for row in range(KEPT):
        block[first + np.uint64(row)] = moments[start + np.uint64(row)]


@part(allocates=False)
def seen_tags(cell: int, index: int, sure: NDArray[np.uint64]) -> np.uint64:
    """Return which of a block's four tags are seen for certain from a cell of the visibility map, four bits."""
    tag = np.uint64(4 * index)
    return np.uint64((sure[cell, tag >> np.uint64(6)] >> (tag & np.uint64(63))) & np.uint64(15))


@part(allocates=False)
def weight_row(alpha: float, beta: float, tables: SphereTables) -> int:
    """Return the row of ``tables.weight`` for a viewpoint."""
    return 0 if len(tables.weight) == 1 else cell_index(alpha, beta, tables.weight_grid)


@part(allocates=False)
def write_seen(tags: np.uint64, slot: int, block: Floats) -> None:
    """Write into ``slot`` (0, 1) weights of 1 for the points of ``tags``, 0 for the others."""
    first, place = tags * np.uint64(LANES), np.uint64((WEIGHT + slot) * LANES)
    for lane in range(LANES):  # loops that only copy become block moves; others between two arrays stay scalar
        block[place + np.uint64(lane)] = FOUR_TAGS[first + np.uint64(lane)]


@part(allocates=False)
def weigh(index: int, row: int, slot: int, weight: Floats, block: Floats) -> None:
    """Multiply the weights in ``slot`` by those of the block's points in ``row`` of ``weight``."""
    start, spare, place = np.uint64(index * LANES), np.uint64(SPARE * LANES), np.uint64((WEIGHT + slot) * LANES)
    for lane in range(LANES):
        block[spare + np.uint64(lane)] = weight[np.uint64(row), start + np.uint64(lane)]
    for lane in range(LANES):
        block[place + np.uint64(lane)] *= block[spare + np.uint64(lane)]


@part(allocates=False)
def add_images(first: int, second: int, sign: float, directions: Floats, radius: float, block: Floats) -> None:
    """Add the images whose weights are in slots 0 and 1, the second times ``sign``; ``directions`` (k, 3)."""
    add_two_cameras(
        block, directions[first, 0], directions[first, 1], directions[first, 2],
        directions[second, 0], directions[second, 1], directions[second, 2], radius, 1.0, sign,
    )  # fmt: skip


@part(allocates=False)
def largest_variance(block: Floats) -> float:
    """Return the largest variance of a block."""
    largest = 0.0
    for row in range(VARIANCES * LANES, (VARIANCES + 3) * LANES):
        largest = max(largest, block[np.uint64(row)])
    return largest


@part(fastmath=FAST, allocates=False)
def precision_objective(values: Floats, tables: SphereTables) -> float:
    """Return f1 from the values of all blocks: the mean variance in m², or the largest sigma in m."""
    if tables.criterion == MAX_SIGMA:
        largest = 0.0
        for value in values:
            largest = max(largest, value)
        return float(math.sqrt(largest * tables.variance))
    total = 0.0
    for value in values:
        total += value
    return total * tables.variance / (3 * tables.point_count)


@part(allocates=False)
def network_blocks(
    viewpoints: Floats, directions: Floats, cells: Ints, rows: Ints, tables: SphereTables, block: Floats,
    values: Floats, moments: Floats,
) -> int:  # fmt: skip
    """Write the values of all blocks for viewpoints (k, 2); return how many points are WEAK.

    Args:
        directions, cells: (k, 3) and (k,) of the viewpoints, known.  rows, block: (k,), (ROWS * LANES,) scratch.
        values: (blocks,).
        moments: (blocks * KEPT,) written when there is room for them, for :mod:`local_search`.
    """
    weak, k = 0, len(viewpoints)
    for i in range(k):
        rows[i] = weight_row(viewpoints[i, 0], viewpoints[i, 1], tables)
    # Only what is needed goes into the inner calls: all of ``tables`` would be counted in and out every time.
    sure, weight, points, radius, count = tables.sure, tables.weight, tables.points, tables.radius, tables.point_count
    worst, varies = tables.criterion == MAX_SIGMA, len(weight) > 1
    for index in range(len(values)):
        write_points(index, points, block)
        waiting = -1  # two at a time
        for i in range(k):
            tags = seen_tags(cells[i], index, sure)
            if tags != np.uint64(0):
                slot = 0 if waiting < 0 else 1
                write_seen(tags, slot, block)
                if varies:
                    weigh(index, rows[i], slot, weight, block)
                if waiting >= 0:
                    add_images(waiting, i, 1.0, directions, radius, block)
                waiting = i if waiting < 0 else -1
        if waiting >= 0:
            add_images(waiting, waiting, 0.0, directions, radius, block)
        value, lost = block_variances(block, radius, count - index * LANES)
        values[index] = largest_variance(block) if worst else value
        weak += lost
        if len(moments) > 0:
            save_moments(index, block, moments)
    return weak
