"""The motion objective in joint space against the one in the workspace: the search's own kernels, side by side.

The default cell of the tests (UR10, sphere of 600 mm), networks of ten reachable stations drawn over the sphere. With a
fixed roll every branch of the arm is an option at every station, with a free one twelve rolls of one branch are. Also
how far the search's quick tours are above the exact optimum over order and options, for eight stations.
"""

import time
from collections.abc import Iterator

import numpy as np
from numba import njit

from netdesign.model.compiled import entry
from netdesign.motion.exact_tour import exact_joint_tour
from netdesign.motion.joint_tour import law_of, network_tour, search_work_for
from netdesign.motion.tour import path_length
from netdesign.placement.evaluation import joint_tours, write_direction
from netdesign.placement.tables import JointTables
from tests.cells import joint_map, reachable_viewpoints
from validation.benchmarks.table import Row

NETWORKS, STATIONS = 1000, 10
EXACT, EXACT_STATIONS = 100, 8
CASES = [("side", 0.0), ("coaxial", 0.0), ("side", None), ("coaxial", None)]

TOUR = entry()(network_tour)


@njit(error_model="numpy")
def _workspace(genes, objectives):
    directions = np.zeros((genes.shape[1], 3))
    for p in range(len(genes)):
        for i in range(genes.shape[1]):
            write_direction(genes[p, i, 0], genes[p, i, 1], directions[i])
        objectives[p, 1] = path_length(directions)


def rows(repeats: int) -> Iterator[Row]:
    """Yield the rows of every camera mount, kind of roll and law."""
    bits = np.ones((NETWORKS, STATIONS), dtype=np.bool_)
    objectives, violation = np.zeros((NETWORKS, 3)), np.zeros(NETWORKS)
    for mount, roll in CASES:
        of_map = joint_map(mount, roll)
        law = law_of(of_map.arm)
        genes = np.stack([reachable_viewpoints(of_map, STATIONS, seed) for seed in range(NETWORKS)])
        name = f"{mount}, roll {'free' if roll is None else 'fixed'}"
        for timed in (False, True):
            tables = JointTables(of_map.arrays, law, timed, 0.5, np.inf)
            pairs = []
            for repeat in range(repeats + 1):  # side by side: the load of the machine meets both
                start = time.process_time()
                _workspace(genes, objectives)
                middle = time.process_time()
                joint_tours(bits, genes, tables, objectives, violation)
                if repeat > 0:
                    pairs.append((middle - start, time.process_time() - middle))
            if violation.any():
                raise RuntimeError(f"{name}: expected stations that can be reached")
            what = f"{'time' if timed else 'joint'} objective, {name}"
            yield Row(f"{what}: speed relative to the workspace's", 0.25, [near / far for near, far in pairs])
            yield Row(f"{what}: viewpoints a second", 1e5, [NETWORKS * STATIONS / far for _, far in pairs])
        yield Row(f"search tours in joints, {name}, n = 8, over the exact", None, [1.0 + _above(of_map, law)])


def _above(of_map, law) -> float:
    nothing = np.empty((0, 0), dtype=np.int64), np.empty((0, 0, 0, 0))
    ratios = []
    for seed in range(EXACT):
        drawn = reachable_viewpoints(of_map, EXACT_STATIONS, seed)
        options, count = of_map.options(drawn)
        *_, best = exact_joint_tour(options, count, *nothing, law, False)
        found, _ = TOUR(of_map.arrays, law, False, 0.0, drawn, *search_work_for(of_map.arrays, len(drawn)))
        ratios.append(found / best)
    return float(np.mean(ratios)) - 1.0
