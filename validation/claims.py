"""The claims of the source paper as measured statements about one Pareto front.

A front is the content of design.json. Each function returns what it measured and whether the criterion holds; a claim
that cannot be judged on a front (too few networks, say) does not hold. f1 is the mean variance (mm²), f2 the length of
the tour, f3 the number of images; sigma is the square root of f1.
"""

from itertools import pairwise

import numpy as np
from scipy.stats import spearmanr

FEWEST_PER_LAYER = 5  # networks of one size from which the shape of its curve is judged


def layers(front):
    """Return {number of images: (k, 2) sigma and tour}, each sorted by tour."""
    found = {}
    for network in front["networks"]:
        f1, f2, f3 = network["objectives"]
        found.setdefault(int(f3), []).append((np.sqrt(f1), f2))
    return {size: np.array(sorted(rows, key=lambda row: row[1])) for size, rows in sorted(found.items())}


def best_per_size(front):
    """Return (s, 2): number of images and the smallest sigma of that size."""
    return np.array([(size, rows[:, 0].min()) for size, rows in layers(front).items()])


def asymptotes(front, depth, ratio):
    """(i) Precision against motion is a convex curve with an asymptote on either side.

    In every layer, scaled to its own range: the mean depth of its networks below the chord between its ends (a straight
    trade-off has 0), and the slope of the first third over the slope of the last third. Medians over the layers.
    """
    large = [rows for rows in layers(front).values() if len(rows) >= FEWEST_PER_LAYER]
    if not large:
        return {"layers": 0, "holds": False}
    depths, ratios = [], []
    for rows in large:
        sigma, tour = ((rows - rows.min(axis=0)) / np.ptp(rows, axis=0)).T
        third = len(rows) // 3
        steep = (sigma[0] - sigma[third]) / (tour[third] - tour[0])
        shallow = (sigma[-1 - third] - sigma[-1]) / (tour[-1] - tour[-1 - third])
        depths.append(float((1.0 - tour - sigma)[1:-1].mean()))
        ratios.append(float(steep / shallow) if shallow > 0 else float("inf"))
    measured = {
        "layers": len(large),
        "median_depth_below_chord": float(np.median(depths)),
        "median_steepness_ratio": float(np.median(ratios)),
    }
    holds = measured["median_depth_below_chord"] >= depth and measured["median_steepness_ratio"] >= ratio
    return measured | {"holds": bool(holds)}


def diminishing_gain(front, low, high):
    """(ii) Each further image gains less: sigma falls like a power of the number of images near -1/2."""
    sizes, sigma = best_per_size(front).T
    if len(sizes) < 4:
        return {"sizes": len(sizes), "holds": False}
    exponent = float(np.polyfit(np.log(sizes), np.log(sigma), 1)[0])
    middle = len(sizes) // 2
    first = float((sigma[0] - sigma[middle]) / (sizes[middle] - sizes[0]))
    last = float((sigma[middle] - sigma[-1]) / (sizes[-1] - sizes[middle]))
    measured = {"sizes": len(sizes), "exponent": exponent, "gain_per_image_first_over_last_half": first / last}
    return measured | {"holds": low <= exponent <= high and first > last}


def more_images_shorter_tour(front, pairs):
    """(iii) Some network with more images has a shorter tour than one with fewer, at no worse precision."""
    f1, f2, f3 = np.array([network["objectives"] for network in front["networks"]]).T
    better = (f3[:, None] > f3) & (f1[:, None] <= f1) & (f2[:, None] < f2)
    gain = 1.0 - np.where(better, f2[:, None] / f2, 1.0)
    measured = {"pairs": int(better.sum()), "largest_saving_of_tour": float(gain.max())}
    return measured | {"holds": measured["pairs"] >= pairs}


def layered(front, sizes):
    """(iv) The front lies in layers, one per number of images: each size has its own, lower, best sigma."""
    best = best_per_size(front)
    falls = sum(after[1] < before[1] for before, after in pairwise(best))
    measured = {"layers": len(best), "smallest": int(best[0, 0]), "largest": int(best[-1, 0]), "steps_that_fall": falls}
    return measured | {"holds": bool(len(best) >= sizes and falls == len(best) - 1)}


def conflict(front, price):
    """(v) The objectives conflict: the shortest tour of a size costs sigma, the best sigma costs tour.

    In every layer, its network of shortest tour and its network of best sigma; medians over the layers of both ratios.
    """
    large = [rows for rows in layers(front).values() if len(rows) >= 2]
    if not large:
        return {"layers": 0, "holds": False}
    measured = {
        "layers": len(large),
        "sigma_of_the_shortest_tour": float(np.median([rows[0, 0] / rows[:, 0].min() for rows in large])),
        "tour_of_the_best_sigma": float(np.median([rows[rows[:, 0].argmin(), 1] / rows[0, 1] for rows in large])),
    }
    holds = measured["sigma_of_the_shortest_tour"] >= price and measured["tour_of_the_best_sigma"] >= price
    return measured | {"holds": bool(holds)}


def limited_is_valid(front, ratio):
    """(vi) Limited error propagation is valid for well designed networks: near the full bundle's sigma.

    Well designed is each size's network of best sigma: the median of total over limited sigma of these. Beside it that
    of the whole front, whose short tours are weak networks, and the rank correlation of the two criteria.
    """
    limited = np.array([network["rms_sigma_um"] for network in front["networks"]])
    total = np.array([network["total_rms_sigma_um"] or np.inf for network in front["networks"]])
    sizes = np.array([network["objectives"][2] for network in front["networks"]])
    best = [int(np.flatnonzero(sizes == size)[limited[sizes == size].argmin()]) for size in np.unique(sizes)]
    measured = {
        "median_of_the_best": float(np.median(total[best] / limited[best])),
        "largest_of_the_best": float((total[best] / limited[best]).max()),
        "median_of_all": float(np.median(total / limited)),
        "largest_of_all": float((total / limited).max()),
        "rank_correlation": float(spearmanr(limited, total).statistic),
    }
    return measured | {"holds": bool(measured["median_of_the_best"] <= ratio)}


CLAIMS = {
    "asymptotes": asymptotes,
    "diminishing_gain": diminishing_gain,
    "more_images_shorter_tour": more_images_shorter_tour,
    "layered": layered,
    "conflict": conflict,
    "limited_is_valid": limited_is_valid,
}
