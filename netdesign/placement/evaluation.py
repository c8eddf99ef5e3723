"""The search's evaluation of networks, compiled: visibility bits, limited error, tour, violation.

A network's violation is the sum of what is missing: rays per tag, tags per image, images that hang together with the
others, stations out of reach, points whose rays are nearly parallel, and the part of the tour beyond the longest
admissible one. Infeasible networks skip what follows the first failing stage. What is reported is computed anew,
exactly, in ``finish``.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import FAST, entry, part
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.motion.joint_tour import SearchWork, Work, network_tour, search_work_for
from netdesign.motion.tour import heuristic_length
from netdesign.photogrammetry.limited_error import LANES, add_four_cameras, variances_from_moments
from netdesign.placement.visibility_map import cell_index

MEAN_VARIANCE, MAX_SIGMA = 0, 1

FOUR_TAGS = np.repeat((np.arange(16)[:, None] >> np.arange(4)) & 1, CORNERS_PER_TAG, axis=1).ravel().astype(np.float64)
"""What four bits become: 1 for every corner of a tag that is seen, (16 x LANES,)."""


class SphereTables(NamedTuple):
    """What the kernels look up; arrays of the visibility map are described there.

    Attributes:
        points: blocks of x, y, z relative to the centre (``limited_error.blocked``).  point_count: m.  tags: g.
        radius: R in m.  grid, sure: of the VisibilityMap.
        weight: (rows, LANES per block) 1 / sigma² of a point's sighting relative to ``variance``; one row when sigma is
            constant.
        weight_grid: (6,) grid of the rows of ``weight``.
        variance: m² per unit of the moment form, sigma² / f².
        min_rays, min_tags: images per tag, tags per image.
        criterion: MEAN_VARIANCE or MAX_SIGMA.
        longest: admissible workspace f2.
        limits: (4,) lowest and highest azimuth, lowest and highest elevation, rad.
        fixed: the first images of every network, which stay where they are.
    """

    points: Floats
    point_count: int
    tags: int
    radius: float
    grid: Floats
    sure: NDArray[np.uint64]
    weight: Floats
    weight_grid: Floats
    variance: float
    min_rays: int
    min_tags: int
    criterion: int
    longest: float
    limits: Floats
    fixed: int = 0


class JointTables(NamedTuple):
    """What the joint-space tour looks up: arrays of the JointMap; law, timed and dwell (s) of ``motion.joint_tour``.

    longest: admissible f2.
    """

    arrays: Any
    law: Floats
    timed: bool
    dwell: float
    longest: float


@part()
def popcount(word: np.uint64) -> int:
    """Return the number of bits set in 64 bits (SWAR; H. S. Warren, Hacker's Delight, chapter 5)."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@part()
def missing_sightings(cells: Ints, tables: SphereTables, at_least: NDArray[np.uint64]) -> float:
    """Return the rays that tags lack plus the shares of tags that images lack, for images in ``cells`` (k,).

    at_least: (min_rays, words) scratch; row r ends up as the bits of the tags seen more than r times.
    """
    words = tables.sure.shape[1]
    at_least[:] = np.uint64(0)
    lacking = 0.0
    for index in range(len(cells)):
        cell = cells[index]
        seen = 0
        for w in range(words):
            row = tables.sure[cell, w]
            seen += popcount(row)
            for r in range(tables.min_rays - 1, 0, -1):
                at_least[r, w] |= at_least[r - 1, w] & row
            at_least[0, w] |= row
        if seen < tables.min_tags and index >= tables.fixed:
            lacking += float(tables.min_tags - seen) / tables.min_tags
    for r in range(tables.min_rays):
        enough = 0
        for w in range(words):
            enough += popcount(at_least[r, w])
        lacking += tables.tags - enough
    return lacking if lacking > 0.0 else float(loose_images(cells, tables.sure, at_least[0]))


@part()
def loose_images(cells: Ints, sure: NDArray[np.uint64], reached: NDArray[np.uint64]) -> int:
    """Return how many images, in ``cells`` (k,), share no tag with the first one, not even by way of others.

    A bundle adjustment cannot tell where such images are. A tag in common is necessary, not sufficient (one image
    alone does not carry the scale of its group): the exact check of ``finish`` decides. Images that see nothing do not
    count. ``reached`` (words,): scratch.
    """
    reached[:] = np.uint64(0)
    loose, before = len(cells), len(cells) + 1
    while 0 < loose < before:
        before, loose = loose, 0
        empty = True
        for w in range(len(reached)):
            empty = empty and reached[w] == np.uint64(0)
        for cell in cells:
            common = own = np.uint64(0)
            for w in range(len(reached)):
                common |= sure[cell, w] & reached[w]
                own |= sure[cell, w]
            if common != np.uint64(0) or empty:
                for w in range(len(reached)):
                    reached[w] |= sure[cell, w]
                empty = empty and own == np.uint64(0)
            elif own != np.uint64(0):
                loose += 1
    return loose


@part()
def write_direction(alpha: float, beta: float, direction: Floats) -> None:
    """Write the unit vector (3,) of a viewpoint."""
    flat = math.cos(beta)
    direction[0], direction[1], direction[2] = flat * math.cos(alpha), flat * math.sin(alpha), math.sin(beta)


@part()
def write_weights(
    alpha: float, beta: float, cell: int, sign: float, slot: int, tables: SphereTables, weights: Floats
) -> None:
    """Write into ``slot`` of blocks of 4 rows what each point's sighting from a viewpoint weighs, times ``sign``."""
    constant = len(tables.weight) == 1
    row = np.uint64(0 if constant else cell_index(alpha, beta, tables.weight_grid))
    for block in range(tables.weight.shape[1] // LANES):
        tag = np.uint64(4 * block)
        four_tags = (tables.sure[cell, tag >> np.uint64(6)] >> (tag & np.uint64(63))) & np.uint64(15)
        start, first = np.uint64((4 * block + slot) * LANES), four_tags * np.uint64(LANES)
        if sign != 1.0:
            for lane in range(LANES):
                weights[start + np.uint64(lane)] = sign * FOUR_TAGS[first + np.uint64(lane)]
        else:
            for lane in range(LANES):
                weights[start + np.uint64(lane)] = FOUR_TAGS[first + np.uint64(lane)]
        if not constant:
            first = np.uint64(block * LANES)
            for lane in range(LANES):
                weights[start + np.uint64(lane)] *= tables.weight[row, first + np.uint64(lane)]


@part()
def write_moments(
    viewpoints: Floats, directions: Floats, cells: Ints, tables: SphereTables, weights: Floats, four: Floats,
    moments: Floats,
) -> None:  # fmt: skip
    """Write the moments of viewpoints (k, 2), whose directions and cells are known; ``weights``, ``four``: scratch."""
    moments[:] = 0.0
    k = len(viewpoints)
    for first in range(0, k, 4):
        for slot in range(4):
            i = min(first + slot, k - 1)
            sign = 1.0 if first + slot < k else 0.0
            write_weights(viewpoints[i, 0], viewpoints[i, 1], cells[i], sign, slot, tables, weights)
            for axis in range(3):
                four[slot, axis] = directions[i, axis]
        add_four_cameras(moments, tables.points, four, weights, tables.radius)


@part(fastmath=FAST)
def precision_objective(variances: Floats, tables: SphereTables) -> float:
    """Return f1 from the variances: their mean in m², or the square root of the largest in m."""
    if tables.criterion == MAX_SIGMA:
        largest = 0.0
        for value in variances:
            largest = max(largest, value)
        return float(math.sqrt(largest * tables.variance))
    total = 0.0
    for value in variances:
        total += value
    return total * tables.variance / (3 * tables.point_count)


@part()
def excess(length: float, longest: float) -> float:
    """Return how far a tour is beyond the longest admissible one, in [0, 1)."""
    return max(0.0, 1.0 - longest / length) if length > 0.0 else 0.0


def joint_tours(bits: Bools, genes: Floats, joint: JointTables, objectives: Floats, violation: Floats) -> None:
    """Replace f2 of the feasible rows by the joint-space tour and add the stations out of reach to their violation."""
    _joint_tours(bits, genes, joint, *search_work_for(joint.arrays, bits.shape[1]), objectives, violation)


@entry(nogil=True)
def _joint_tours(
    bits: Bools, genes: Floats, joint: JointTables, own: SearchWork, work: Work, objectives: Floats, violation: Floats
) -> None:
    """Apart from :func:`evaluate_networks`: compiled into it, the tour over options would take half as long again."""
    count, slots = bits.shape
    viewpoints = np.zeros((slots, 2))
    for p in range(count):
        if violation[p] > 0:
            continue
        k = 0
        for slot in range(slots):
            if bits[p, slot]:
                viewpoints[k, 0], viewpoints[k, 1] = genes[p, slot, 0], genes[p, slot, 1]
                k += 1
        length, refused = network_tour(joint.arrays, joint.law, joint.timed, joint.dwell, viewpoints[:k], own, work)
        objectives[p, 1] = length
        violation[p] = refused + excess(length, joint.longest)


@entry(nogil=True)
def evaluate_networks(bits: Bools, genes: Floats, tables: SphereTables, objectives: Floats, violation: Floats) -> None:
    """Write objectives (P, 3) and violation (P,) of chromosomes: bits (P, n), genes (P, n, 2) = (alpha, beta) rad.

    f2 is 0, or inf where a sighting is missing: :func:`workspace_tours` or :func:`joint_tours` follows.
    """
    count, slots = bits.shape
    blocks = len(tables.points) // (3 * LANES)
    viewpoints, directions = np.zeros((slots, 2)), np.zeros((slots, 3))
    four = np.zeros((4, 3))
    cells = np.zeros(slots, np.int64)
    at_least = np.zeros((tables.min_rays, tables.sure.shape[1]), np.uint64)
    weights, moments = np.zeros(blocks * 4 * LANES), np.zeros(blocks * 9 * LANES)
    variances = np.zeros(blocks * 3 * LANES)
    for p in range(count):
        k = 0
        for slot in range(slots):
            if bits[p, slot]:
                alpha, beta = genes[p, slot, 0], genes[p, slot, 1]
                viewpoints[k, 0], viewpoints[k, 1] = alpha, beta
                write_direction(alpha, beta, directions[k])
                cells[k] = cell_index(alpha, beta, tables.grid)
                k += 1
        objectives[p, 0], objectives[p, 1], objectives[p, 2] = np.inf, np.inf, k
        lacking = missing_sightings(cells[:k], tables, at_least)
        if lacking > 0:
            violation[p] = 1.0 + lacking  # always worse than a tour that is too long
            continue
        write_moments(viewpoints[:k], directions, cells, tables, weights, four, moments)
        violation[p] = variances_from_moments(moments, tables.points, tables.radius, tables.point_count, variances)
        objectives[p, 0], objectives[p, 1] = precision_objective(variances, tables), 0.0


@entry(nogil=True)
def workspace_tours(
    bits: Bools, genes: Floats, radius: float, longest: float, objectives: Floats, violation: Floats
) -> None:
    """Replace f2 of the rows without missing sightings by the workspace tour; add what is beyond the longest."""
    count, slots = bits.shape
    directions = np.zeros((slots, 3))
    for p in range(count):
        if objectives[p, 1] == np.inf:
            continue
        k = 0
        for slot in range(slots):
            if bits[p, slot]:
                write_direction(genes[p, slot, 0], genes[p, slot, 1], directions[k])
                k += 1
        objectives[p, 1] = radius * heuristic_length(directions[:k])
        violation[p] += excess(objectives[p, 1], longest)
