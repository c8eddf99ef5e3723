"""The search's evaluation of networks, compiled: visibility bits, limited error, tour, violation.

A network's violation is the sum of what is missing: rays per tag, tags per image, images that hang together with the
others, stations out of reach, points whose rays are nearly parallel, and the part of the tour beyond the longest
admissible one. Infeasible networks skip what follows the first failing stage. What is reported is computed anew,
exactly, in ``finish``.
"""

import math

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry, part
from netdesign.motion.joint_tour import SearchWork, Work, network_tour, search_work_for
from netdesign.motion.tour import heuristic_length
from netdesign.photogrammetry.limited_error import LANES, ROWS
from netdesign.placement.blocks import network_blocks, precision_objective
from netdesign.placement.tables import JointTables, SphereTables
from netdesign.placement.visibility_map import cell_index


@part(allocates=False)
def popcount(word: np.uint64) -> int:
    """Return the number of bits set in 64 bits (SWAR; H. S. Warren, Hacker's Delight, chapter 5)."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@part(allocates=False)
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


@part(allocates=False)
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


@part(allocates=False)
def write_direction(alpha: float, beta: float, direction: Floats) -> None:
    """Write the unit vector (3,) of a viewpoint."""
    flat = math.cos(beta)
    direction[0], direction[1], direction[2] = flat * math.cos(alpha), flat * math.sin(alpha), math.sin(beta)


@part(allocates=False)
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
    cells, rows = np.zeros(slots, np.int64), np.zeros(slots, np.int64)
    at_least = np.zeros((tables.min_rays, tables.sure.shape[1]), np.uint64)
    block, values, moments = np.zeros(ROWS * LANES), np.zeros(blocks), np.zeros(0)
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
        violation[p] = network_blocks(viewpoints[:k], directions, cells, rows, tables, block, values, moments)
        objectives[p, 0], objectives[p, 1] = precision_objective(values, tables), 0.0


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
