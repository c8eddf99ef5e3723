"""What a search hands over: precision, tours and the front."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from netdesign.model.arrays import Floats, Ints, frozen

Propagation = Literal["limited", "total"]
Space = Literal["workspace", "joint", "time"]


@dataclass(frozen=True, kw_only=True)
class PointPrecision:
    """Predicted covariance of the object points.

    Attributes:
        covariance: (m, 3, 3) m²; an undetermined point is inf, never NaN.
        rays: (m,) images that see the point.
        propagation: "limited" (exterior orientation error-free) or "total" (full bundle adjustment).
        datum: what the covariance refers to; a sigma without its datum is not a number.
    """

    covariance: Floats
    rays: Ints
    propagation: Propagation
    datum: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen("covariance", self.covariance, ("m", 3, 3)))
        object.__setattr__(self, "rays", frozen("rays", self.rays, (len(self.covariance),), np.int64))

    @property
    def sigma(self) -> Floats:
        """(m, 3) standard deviations along the world axes, m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def mean_variance(self) -> float:
        """f1 of the source paper (equation 2): trace(Q2) sigma0² / 3m, in m²."""
        return float(np.trace(self.covariance, axis1=1, axis2=2).sum() / (3 * len(self.covariance)))


@dataclass(frozen=True, kw_only=True)
class Tour:
    """An open path over the stations of a network.

    Attributes:
        order: (n,) station indices in visiting order.
        length: sum of the legs: m (workspace), weighted rad (joint), s (time, dwell included), over the via points.
        joints: (n, r) rad in visiting order, or None without a robot.
        vias: via points (k, r) rad of the legs that need them, by number of the leg; leg i leaves station i.
    """

    order: Ints
    length: float
    space: Space
    joints: Floats | None = None
    vias: dict[int, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "order", frozen("order", self.order, ("n",), np.int64))
        if self.joints is not None:
            object.__setattr__(self, "joints", frozen("joints", self.joints, (len(self.order), "r")))


@dataclass(frozen=True, kw_only=True)
class DesignedNetwork:
    """One network of the front; per-image arrays are in visiting order.

    Attributes:
        viewpoints: (n, 2) alpha, beta in rad.  radius: (n,) m, distance from the centre, None: that of the sphere.
        world_from_cam: (n, 4, 4) m.
        f1, f2, f3: the objectives in SI units: m² (or m for the worst point), tour length, number of images.
        precision: the search criterion's propagation; total: full bundle adjustment, inner constraints over all points.
        bound_ratio: f1 / lower bound for this number of images, >= 1; None when no bound was computed.
        warnings: what the total propagation or the robot has to say about it.
        flagged: the total propagation finds it weak: such a network is recommended only when there is no other.
    """

    viewpoints: Floats
    world_from_cam: Floats
    f1: float
    f2: float
    f3: int
    tour: Tour
    precision: PointPrecision
    total: PointPrecision | None
    bound_ratio: float | None
    warnings: tuple[str, ...] = ()
    flagged: bool = False
    radius: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewpoints", frozen("viewpoints", self.viewpoints, ("n", 2)))
        count = len(self.viewpoints)
        object.__setattr__(self, "world_from_cam", frozen("world_from_cam", self.world_from_cam, (count, 4, 4)))
        if self.radius is not None:
            object.__setattr__(self, "radius", frozen("radius", self.radius, (count,)))


@dataclass(frozen=True, kw_only=True)
class SearchHistory:
    """Progress of a search.

    Attributes:
        evaluations: (h,) networks evaluated so far.  hypervolume: (h,) of the archive, normalised to [0, 1].
    """

    evaluations: Ints
    hypervolume: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "evaluations", frozen("evaluations", self.evaluations, ("h",), np.int64))
        object.__setattr__(self, "hypervolume", frozen("hypervolume", self.hypervolume, (len(self.evaluations),)))


@dataclass(frozen=True, kw_only=True)
class Design:
    """The Pareto front of a study, sorted by number of images, then f1.

    Attributes:
        bounds: proven lower bound on f1 (m²) for each number of images it was computed for.
        answer: index of the cheapest network that keeps the study's requirements; None when none does or none is asked.
        answer_reason: how it keeps them, or what binds and what would satisfy it; None when nothing is asked.
    """

    networks: tuple[DesignedNetwork, ...]
    history: SearchHistory
    bounds: dict[int, float]
    notes: tuple[str, ...] = ()
    answer: int | None = None
    answer_reason: str | None = None
