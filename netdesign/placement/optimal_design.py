"""Networks near the best f1 that any number of images can reach: the continuous optimum, rounded to whole images.

The continuous relaxation of the design problem gives every candidate viewpoint a weight and minimises Σ_j tr(N_j⁻¹)
with N_j = Σ_i w_i M_ij (A-optimality; multiplicative algorithm: Y. Yu, Annals of Statistics 38(3), 2010). It is convex,
needs no start and knows no local optimum: its few stations are where images tell most about this part. ``bound`` draws
the certificate from it, ``rounded_networks`` the seeds of the search: k images with the largest shares, then exchanged
one at a time (V. V. Fedorov, Theory of Optimal Experiments, 1972) until no exchange helps.
"""

from collections.abc import Callable, Iterable

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.task import Task
from netdesign.photogrammetry.collinearity import point_jacobians
from netdesign.photogrammetry.precision import sighting_sigma

# The weights are settled when no candidate stands out from their mean by more than this.
TOLERANCE = 1e-3
ITERATIONS = 400
STATIONS = 32  # of the optimum that take part in the exchange
IMAGES = 64  # at a time: their derivatives stay near the processor
PASSES = 2  # a third changes f1 by less than 0.3 %

Score = Callable[[Bools, Floats], tuple[Floats, Floats]]
"""(bits (P, n), genes (P, n, d)) to (f1 (P,), violation (P,))."""


def optimal_weights(flat: Floats, weights: Floats, iterations: int = ITERATIONS) -> tuple[Ints, Floats]:
    """Improve ``weights`` (c,) of candidates with matrices (c, 6 m); return the rows that still matter, their weights.

    w_i grows with a power of h(v_i) = Σ_j tr(N_j⁻¹ M_ij N_j⁻¹) over the weighted mean of h; at the optimum h is the
    mean where w > 0 and smaller elsewhere. (The exponent 1/2 is proved to converge, 0.8 is faster here.)
    """
    active = np.arange(len(weights))
    for iteration in range(iterations):
        # Never negative but for rounding, where a point has nearly parallel rays only.
        height = np.maximum(flat @ squares(inverses(flat, weights)).ravel(), 0.0)
        mean = float(weights @ height)
        if height.max() <= (1.0 + TOLERANCE) * mean:
            break
        weights = weights * (height / mean) ** 0.8
        weights /= weights.sum()
        if iteration % 25 == 24:
            keep = weights > 1e-2 / len(weights)
            active, flat, weights = active[keep], flat[keep], weights[keep] / weights[keep].sum()
    return active, weights


def inverses(flat: Floats, weights: Floats) -> Floats:
    """Return (6, m) inverses of Σ_i w_i M_ij for flattened matrices (c, 6 m): xx xy xz yy yz zz of every point."""
    xx, xy, xz, yy, yz, zz = np.ascontiguousarray((weights @ flat).reshape(-1, 6).T)
    # A point with nearly parallel rays only: its inverse need not be exact, but its square must not drown in rounding.
    little = 1e-6 * (xx + yy + zz)
    xx, yy, zz = xx + little, yy + little, zz + little
    x, y, z = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    adjugate = np.stack([x, y, z, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy])
    return np.asarray(adjugate / (xx * x + xy * y + xz * z), dtype=np.float64)


def squares(symmetric: Floats) -> Floats:
    """Return (m, 6) such that the product with the rows of M is tr(S² M), from S (6, m) as of ``inverses``."""
    xx, xy, xz, yy, yz, zz = symmetric
    found = np.empty((len(xx), 6))
    found[:, 0], found[:, 3], found[:, 5] = xx**2 + xy**2 + xz**2, xy**2 + yy**2 + yz**2, xz**2 + yz**2 + zz**2
    found[:, 1] = 2.0 * (xx * xy + xy * yy + xz * yz)
    found[:, 2] = 2.0 * (xx * xz + xy * yz + xz * zz)
    found[:, 4] = 2.0 * (xy * xz + yy * yz + yz * zz)
    return found


def information_of(task: Task, world_from_cam: Floats, visible: Bools) -> Floats:
    """Return (c, 6 m) what images with poses (c, 4, 4) that see points visible (c, m) add to the normal matrices."""
    points, found = task.scene.targets.points, np.zeros((*visible.shape, 6))
    for first in range(0, len(visible), IMAGES):
        poses, seen = world_from_cam[first : first + IMAGES], visible[first : first + IMAGES]
        image, point = np.nonzero(seen)
        derivative = point_jacobians(poses[image], points[point], task.camera.intrinsics)
        weight = 1.0 / sighting_sigma(task.camera, poses, task.scene.targets)[seen] ** 2
        x, y = np.moveaxis(np.sqrt(weight)[:, None, None] * derivative, 1, 0)
        upper = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
        found[first + image, point] = x[:, upper[0]] * x[:, upper[1]] + y[:, upper[0]] * y[:, upper[1]]
    return found.reshape(len(found), 6 * len(points))


def rounded_networks(candidates: Floats, flat: Floats, sizes: Iterable[int], score: Score) -> list[Floats]:
    """Return for each size k the genes (k, d) of a network of k candidates that is near the best f1 for that size.

    Args:
        candidates: (c, d) genes.  flat: (c, 6 m) their normal matrices.
        score: f1 and violation of networks; what violates least, then has the least f1, is better.
    """
    active, weights = optimal_weights(flat, np.full(len(flat), 1.0 / len(flat)))
    order = np.argsort(-weights, kind="stable")[:STATIONS]
    stations, shares = candidates[active[order]], weights[order] / weights[order].sum()
    return [stations[_exchanged(stations, _apportioned(shares, k), score)] for k in sizes]


def _apportioned(shares: Floats, count: int) -> Ints:
    """(count,) stations, each as often as its share asks for, the largest remainders rounded up."""
    often = np.floor(count * shares).astype(np.int64)
    remainder = count * shares - often
    often[np.argsort(-remainder, kind="stable")[: count - often.sum()]] += 1
    return np.repeat(np.arange(len(shares)), often)


def _exchanged(stations: Floats, chosen: Ints, score: Score) -> Ints:
    """Exchange one image of ``chosen`` (k,) after the other for the station that serves best, until none helps."""
    count, bits = len(stations), np.ones((len(stations), len(chosen)), np.bool_)
    best = (np.inf, np.inf)
    unchanged = 0
    for turn in range(PASSES * len(chosen)):
        place = turn % len(chosen)
        trial = np.tile(chosen, (count, 1))
        trial[:, place] = np.arange(count)
        f1, violation = score(bits, stations[trial])
        row = int(np.lexsort((np.arange(count), f1, violation))[0])
        if (violation[row], f1[row]) < best:
            best, chosen, unchanged = (float(violation[row]), float(f1[row])), trial[row], 0
        else:
            unchanged += 1
            if unchanged == len(chosen):
                break
    return chosen
