"""Total error propagation against GTSAM's marginals and COLMAP's covariance: n = 30, m = 200.

A third of all sightings exist, as in the other rows (targets around a closed part); the ratios at full visibility are
printed beside it: our kernel skips what is not seen, the dense solvers do not.
"""

import time
from collections.abc import Iterator

import numpy as np
import pycolmap

from netdesign.adjustment.bundle import joint_marginals
from netdesign.photogrammetry.datum import inner_basis
from netdesign.photogrammetry.total_trace import total_trace
from tests.bundle_cases import INTRINSICS, observe, problem_of, random_visibility, relief
from tests.test_third_opinions import SIGMA, _colmap
from validation.benchmarks.table import Row

IMAGES, POINTS, SHARE = 30, 200, 0.34


def rows(repeats: int) -> Iterator[Row]:
    """Yield the ratios; building COLMAP's reconstruction is not counted."""
    for what, ratios in _ratios(SHARE, repeats).items():
        yield Row(f"total-error kernel against {what}", 30.0 if "gtsam" in what else 3.0, ratios)
    for what, ratios in _ratios(1.0, max(2, repeats // 2)).items():
        yield Row(f"the same against {what}, every point in every image: {np.median(ratios):.1f}", None, [])


def _ratios(share: float, repeats: int) -> dict[str, list[float]]:
    """How many times as long the others take, when ``share`` of the points is seen in an image."""
    poses, points = relief(IMAGES, POINTS, seed=3)
    visible = random_visibility(IMAGES, POINTS, share)
    observations = observe(poses, points, visible, SIGMA, noise=False)
    problem, used, basis = problem_of(observations, poses, points), np.ones(POINTS, bool), inner_basis(points)
    reconstruction, adjuster = _colmap(poses, points, observations)
    options, sigma = pycolmap.BACovarianceOptions(), np.array([[SIGMA]])
    values: dict[str, list[float]] = {"ours": [], "gtsam": [], "pycolmap": []}
    sides = {
        "ours": lambda: total_trace(poses, points, INTRINSICS, visible, sigma, basis),
        "gtsam": lambda: np.trace(joint_marginals(problem, used)),
        "pycolmap": lambda: pycolmap.estimate_ba_covariance(options, reconstruction, adjuster),
    }
    np.testing.assert_allclose(sides["ours"](), sides["gtsam"](), rtol=1e-6)
    for _ in range(repeats):
        for name, side in sides.items():
            calls = 10 if name == "ours" else 1
            start = time.process_time()
            for _ in range(calls):
                side()
            values[name].append((time.process_time() - start) / calls)
    return {
        what: [slow / fast for slow, fast in zip(values[name], values["ours"], strict=True)]
        for name, what in (("gtsam", "gtsam Marginals"), ("pycolmap", "pycolmap covariance"))
    }
