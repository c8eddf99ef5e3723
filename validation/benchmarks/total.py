"""Total error propagation against GTSAM's marginals and COLMAP's covariance: 30 images, 200 points, known intrinsics.

Two networks: a third of all sightings exist (targets around a closed part), and every point is in every image. Each
side starts from what its own library holds (arrays, factor graph, reconstruction with a bundle adjuster); building
that is not counted, linearising is:

* ours: the trace of the points' joint covariance with inner constraints, from poses, points and the table of sightings;
* GTSAM: ``Marginals`` (Cholesky, all that its Python package offers) and the joint covariance of all points, carried to
  the same datum: the same trace. Marginals point by point take as long and cannot be carried;
* COLMAP: ``estimate_ba_covariance`` of poses and points, the fastest of its choices that leaves the poses unknown. It
  reduces the same normal equations and inverts them, but hands out the points' covariance with the poses held, so it
  lacks the last step. With ``POINTS`` alone it is limited error propagation: the row of the limited kernel.
"""

import time
from collections.abc import Callable, Iterator

import gtsam
import numpy as np
import pycolmap
from gtsam.symbol_shorthand import L

from netdesign.adjustment.bundle import _graph
from netdesign.photogrammetry.datum import inner_basis, s_transformation
from netdesign.photogrammetry.total_trace import total_trace
from tests.bundle_cases import INTRINSICS, observe, problem_of, random_visibility, relief
from tests.test_third_opinions import SIGMA, _colmap
from validation.benchmarks.table import Row

IMAGES, POINTS = 30, 200
SHARES = {"a third of the sightings": 0.34, "every point in every image": 1.0}
LIMITS = {"gtsam Marginals": 30.0, "pycolmap covariance": 3.0}
CALLS = {"ours": 20, "gtsam Marginals": 1, "pycolmap covariance": 3}  # so that each measurement takes some 20 ms


def rows(repeats: int) -> Iterator[Row]:
    """Yield how many times as long the others take."""
    for seen, share in SHARES.items():
        sides = _sides(share)
        np.testing.assert_allclose(sides["ours"](), sides["gtsam Marginals"](), rtol=1e-6)
        seconds: dict[str, list[float]] = {name: [] for name in sides}
        for _ in range(repeats):
            for name, side in sides.items():
                start = time.process_time()
                for _ in range(CALLS[name]):
                    side()
                seconds[name].append((time.process_time() - start) / CALLS[name])
        for name, limit in LIMITS.items():
            ratios = [slow / fast for slow, fast in zip(seconds[name], seconds["ours"], strict=True)]
            yield Row(f"total-error kernel against {name}, {seen}", limit, ratios)


def _sides(share: float) -> dict[str, Callable[[], object]]:
    """The three computations on a network of which ``share`` of the sightings exist."""
    poses, points = relief(IMAGES, POINTS, seed=3)
    visible = random_visibility(IMAGES, POINTS, share)
    observations = observe(poses, points, visible, SIGMA, noise=False)
    basis, sigma = inner_basis(points), np.array([[SIGMA]])
    graph, values = _graph(problem_of(observations, poses, points))
    keys = [L(j) for j in range(POINTS)]
    reconstruction, adjuster = _colmap(poses, points, observations)
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.POSES_AND_POINTS

    def by_gtsam() -> float:
        joint = gtsam.Marginals(graph, values).jointMarginalCovariance(keys).fullMatrix()
        return float(np.trace(s_transformation(np.asarray(joint), points)))

    return {
        "ours": lambda: total_trace(poses, points, INTRINSICS, visible, sigma, basis),
        "gtsam Marginals": by_gtsam,
        "pycolmap covariance": lambda: pycolmap.estimate_ba_covariance(options, reconstruction, adjuster),
    }
