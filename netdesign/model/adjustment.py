"""What goes into a bundle adjustment besides image points, and what comes out of it and of its proof."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints, frozen
from netdesign.model.network import Observations

Datum = Literal["free", "fixed", "control", "scale", "poses"]


@dataclass(frozen=True, kw_only=True)
class ControlPoints:
    """Object points whose coordinates are known.

    Attributes:
        point: (p,) indices.  xyz: (p, 3) m.
        sigma: (p, 3) m, or (p,) for all axes alike; 0 on all three axes: error-free; infinite: not known along that
            axis.
    """

    point: Ints
    xyz: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", frozen("point", self.point, ("p",), np.int64))
        object.__setattr__(self, "xyz", frozen("xyz", self.xyz, (len(self.point), 3)))
        sigma = np.asarray(self.sigma, dtype=np.float64)
        spread = np.repeat(sigma[:, None], 3, axis=1) if sigma.ndim == 1 else sigma
        object.__setattr__(self, "sigma", frozen("sigma", spread, (len(self.point), 3)))
        if ((self.sigma == 0).any(axis=1) != (self.sigma == 0).all(axis=1)).any():
            raise ValueError("sigma: expected 0 on all axes of a point or on none")

    @property
    def exact(self) -> Bools:
        """(p,) which points are free of error."""
        return np.asarray((self.sigma == 0).all(axis=1))

    @property
    def whole(self) -> Bools:
        """(p,) which points are known along all axes."""
        return np.asarray(np.isfinite(self.sigma).all(axis=1))


@dataclass(frozen=True, kw_only=True)
class ScaleBars:
    """Known distances between object points.

    Attributes:
        a, b: (q,) point indices.  length, sigma: (q,) m; sigma 0 means error-free.
    """

    a: Ints
    b: Ints
    length: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "a", frozen("a", self.a, ("q",), np.int64))
        for name in ("b", "length", "sigma"):
            dtype = np.int64 if name == "b" else np.float64
            object.__setattr__(self, name, frozen(name, getattr(self, name), (len(self.a),), dtype))


@dataclass(frozen=True, kw_only=True)
class PosePriors:
    """Poses known beforehand, from a robot or a satellite receiver say; independent from image to image.

    Attributes:
        world_from_cam: (p, 4, 4) m.  image: (p,) image indices; default: all images in their order.
        sigma_position: (p,) m per axis.  sigma_rotation: (p,) rad per axis. One number stands for all; inf: unknown.
    """

    world_from_cam: Floats
    sigma_position: float | Floats
    sigma_rotation: float | Floats
    image: Ints | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "world_from_cam", frozen("world_from_cam", self.world_from_cam, ("p", 4, 4)))
        count = len(self.world_from_cam)
        image = np.arange(count) if self.image is None else self.image
        object.__setattr__(self, "image", frozen("image", image, (count,), np.int64))
        for name in ("sigma_position", "sigma_rotation"):
            sigma = np.broadcast_to(np.asarray(getattr(self, name), dtype=np.float64), (count,))
            object.__setattr__(self, name, frozen(name, sigma, (count,)))

    @property
    def weights(self) -> tuple[Ints, Floats, Floats]:
        """Image indices (p,), 1/sigma of positions (p,) in 1/m and of rotations (p,) in 1/rad; 0 where unknown."""
        assert self.image is not None
        return self.image, 1.0 / np.asarray(self.sigma_position), 1.0 / np.asarray(self.sigma_rotation)


@dataclass(frozen=True, kw_only=True)
class Rejection:
    """An image point that the outlier test removed: its index pair and its test statistic (chi² with 2 dof)."""

    image: int
    point: int
    statistic: float


@dataclass(frozen=True, kw_only=True)
class Adjustment:
    """A least-squares bundle adjustment: estimates, covariances a priori (sigma0 = 1), reliability and diagnosis.

    Attributes:
        world_from_cam: (n, 4, 4) m.  points: (m, 3) m.  intrinsics: (c, 8), one row per camera.
        camera_of_image: (n,) row of ``intrinsics``.
        observations: the k image points that were used.  residuals_px: (k, 2) observed - computed.
        redundancy_numbers: (k, 2) per image coordinate; with those of ``extra_redundancy`` they sum to ``redundancy``.
        extra_redundancy: of control coordinates, scale bars and pose priors together.
        point_covariance: (m, 3, 3) m²; inf for a point without an estimate, 0 for a fixed one.
        inner_covariance: (m, 3, 3) m², carried to inner constraints over all adjusted points by S-transformation.
        joint_covariance: (3m, 3m) m², or None when not asked for.
        pose_covariance: (n, 6, 6), tangent omega (rad), v (m) in the camera frame.
        parameter_names: free interior parameters, camera by camera; parameter_covariance: (p, p).
        sigma0: a-posteriori, dimensionless; nan when redundancy is 0.
        n_unknowns, n_datum: unknowns and datum constraints; redundancy = observations - unknowns + datum.
        datum: in words; a sigma without its datum is not a number.
        used: (m,) points that have an estimate.
        lambda8: smallest eigenvalue of the scaled reduced normals that the datum does not explain.
    """

    world_from_cam: Floats
    points: Floats
    intrinsics: Floats
    camera_of_image: Ints
    observations: Observations
    residuals_px: Floats
    redundancy_numbers: Floats
    extra_redundancy: float
    point_covariance: Floats
    inner_covariance: Floats
    joint_covariance: Floats | None
    pose_covariance: Floats
    parameter_names: tuple[str, ...]
    parameter_covariance: Floats
    sigma0: float
    n_observations: int
    n_unknowns: int
    n_datum: int
    redundancy: int
    datum: str
    used: Bools
    iterations: int
    converged: bool
    lambda8: float
    rejected: tuple[Rejection, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def rays(self) -> Ints:
        """(m,) image points used per object point."""
        return np.bincount(self.observations.point, minlength=len(self.points)).astype(np.int64)

    @property
    def sigma_position(self) -> Floats:
        """(n, 3) a-priori standard deviations of the projection centres along the world axes, m."""
        rotation = self.world_from_cam[:, :3, :3]
        covariance = rotation @ self.pose_covariance[:, 3:, 3:] @ np.swapaxes(rotation, 1, 2)
        return np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A statistic, its acceptance interval under the null hypothesis, and its probability integral transform.

    Attributes:
        value, low, high: the statistic and the two-sided interval of the stated level.
        pit: P(statistic <= value) under the null hypothesis: uniform if the prediction is right.
    """

    value: float
    low: float
    high: float
    pit: float

    @property
    def inside(self) -> bool:
        """The value lies in its interval."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True, kw_only=True)
class Validation:
    """Predicted against achieved accuracy of one network, one realisation, in one datum.

    Attributes:
        errors: (m, 3) m, estimate minus truth after similarity alignment; rows of NaN for points without an estimate.
        predicted: root mean square sigma per coordinate in m under "limited" (P0, at design), "total" (P1, at design)
            and "used" (P2, total on the observations that were used); inf when not determined.
        achieved_rms: root mean square of ``errors``, m.
        t, s0_squared, f, rho: the statistics of the network: full covariance, image noise, geometry alone, RMS ratio.
        coverage, nees: share of points inside their 95 % ellipsoid, and mean normalised squared error over 3.
        sums: T, nu, v'Pv, r and their moments: what a campaign pools.  level: of the intervals.
        nu_eff: effective degrees of freedom of rho, (Σλ)² / Σλ².
        log_rho_mean, log_rho_sd: mean and standard deviation of log rho when the prediction is right.
        passed: T, F and rho inside their intervals.  reasons: why not, in words.
    """

    errors: Floats
    predicted: dict[str, float]
    achieved_rms: float
    t: Interval
    s0_squared: Interval
    f: Interval
    rho: Interval
    coverage: Interval
    nees: Interval
    sums: dict[str, float]
    nu_eff: float
    log_rho_mean: float
    log_rho_sd: float
    level: float
    passed: bool
    datum: str
    points_used: int
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)
