"""What the search's kernels look up about a study."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Floats

MEAN_VARIANCE, MAX_SIGMA = 0, 1


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
