"""Observation equations of a bundle: image points of several cameras, some interior orientation free.

The camera-side unknowns stand in this order: 6 per image (tangent omega, v), the free interior parameters camera by
camera, 3 per point that is kept on the camera side because a scale bar ties it to another.

A free interior parameter is a column of an (8, p) matrix: d(fx, fy, cx, cy, k1, k2, p1, p2) = matrix @ dk. That is how
"f" moves fx and fy together while "fx" and "fy" move apart.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.network import Observations
from netdesign.photogrammetry.collinearity import INTRINSIC_NAMES, project_with_jacobians
from netdesign.photogrammetry.normals import Linearised

PARAMETER_NAMES = ("f", *INTRINSIC_NAMES)


def parameter_matrix(names: tuple[str, ...], intrinsics: Floats) -> Floats:
    """Return (8, p): how free parameters ``names`` of PARAMETER_NAMES move one camera's intrinsics (8,).

    "f" keeps the ratio fy/fx.

    Raises:
        ValueError: an unknown or repeated name, or f together with fx or fy.
    """
    unknown = [name for name in names if name not in PARAMETER_NAMES]
    if unknown or len(set(names)) != len(names):
        raise ValueError(f"refine: expected a subset of {', '.join(PARAMETER_NAMES)}, found {', '.join(names)}")
    if "f" in names and ("fx" in names or "fy" in names):
        raise ValueError("refine: f moves fx and fy together; name either f or fx, fy")
    matrix = np.zeros((8, len(names)))
    for column, name in enumerate(names):
        if name == "f":
            matrix[0, column], matrix[1, column] = 1.0, intrinsics[1] / intrinsics[0]
        else:
            matrix[INTRINSIC_NAMES.index(name), column] = 1.0
    return matrix


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which unknown stands in which camera-side column.

    Attributes:
        images: n.  camera_of_image: (n,) camera index.
        parameters: one (8, p_c) matrix per camera.  kept: (m,) points on the camera side.
        eliminated: (m,) points that are unknown and not kept; neither kept nor eliminated = fixed.
    """

    images: int
    camera_of_image: Ints
    parameters: tuple[Floats, ...]
    kept: Bools
    eliminated: Bools

    @property
    def parameter_start(self) -> Ints:
        """(c + 1,) first column of each camera's free parameters."""
        return 6 * self.images + np.concatenate([[0], np.cumsum([matrix.shape[1] for matrix in self.parameters])])

    @property
    def kept_start(self) -> Ints:
        """(m,) first column of each kept point, -1 for the others."""
        position = np.cumsum(self.kept) - 1
        return np.where(self.kept, self.parameter_start[-1] + 3 * position, -1).astype(np.int64)

    @property
    def width(self) -> int:
        """W, the number of camera-side unknowns."""
        return int(self.parameter_start[-1]) + 3 * int(self.kept.sum())


def whitener(covariance: Floats) -> Floats:
    """Return L⁻¹ (k, 2, 2) of covariances (k, 2, 2) = L Lᵀ, so that L⁻¹ e has unit covariance.

    Raises:
        ValueError: a covariance that is not positive definite or not finite.
    """
    sxx, sxy, syy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        rest = syy - sxy * sxy / sxx
        good = np.isfinite(covariance).all(axis=(1, 2)) & (sxx > 0) & (rest > 0)
    if not good.all():
        raise ValueError(f"covariance of observation {int(np.argmin(good))}: expected positive definite")
    lower = np.zeros_like(covariance)
    lower[:, 0, 0] = 1.0 / np.sqrt(sxx)
    lower[:, 1, 1] = 1.0 / np.sqrt(rest)
    lower[:, 1, 0] = -sxy / sxx * lower[:, 1, 1]
    return lower


def linearise(
    observations: Observations,
    layout: Layout,
    world_from_cam: Floats,
    points: Floats,
    intrinsics: Floats,
    whiten: Floats,
) -> tuple[Linearised, Floats]:
    """Return the whitened observation equations and the depths (k,) at the given approximation.

    Args:
        world_from_cam: (n, 4, 4).  points: (m, 3).  intrinsics: (c, 8).
        whiten: (k, 2, 2) from ``whitener``, times the root of a robust weight if there is one.
    """
    image, point = observations.image, observations.point
    camera = layout.camera_of_image[image]
    projection = project_with_jacobians(world_from_cam[image], points[point], intrinsics[camera])
    most = max((matrix.shape[1] for matrix in layout.parameters), default=0)
    slots = 6 + most + (3 if layout.kept.any() else 0)
    columns = np.full((len(image), slots), -1, dtype=np.int64)
    columns[:, :6] = 6 * image[:, None] + np.arange(6)
    derivative = np.zeros((len(image), 2, slots))
    derivative[:, :, :6] = projection.d_xy_d_pose
    for index, matrix in enumerate(layout.parameters):
        rows, count = camera == index, matrix.shape[1]
        columns[rows, 6 : 6 + count] = layout.parameter_start[index] + np.arange(count)
        derivative[rows, :, 6 : 6 + count] = projection.d_xy_d_intrinsics[rows] @ matrix
    if layout.kept.any():
        rows = layout.kept[point]
        columns[rows, -3:] = layout.kept_start[point[rows]][:, None] + np.arange(3)
        derivative[rows, :, -3:] = projection.d_xy_d_point[rows]
    count, width = len(points), layout.width
    return (
        Linearised(
            columns=columns,
            camera=whiten @ derivative,
            point_part=whiten @ projection.d_xy_d_point,
            point=point,
            residual=np.einsum("kij,kj->ki", whiten, observations.xy_px - projection.xy_px),
            width=width,
            eliminated=layout.eliminated,
            point_prior=np.zeros((count, 3, 3)),
            point_prior_rhs=np.zeros((count, 3)),
            camera_prior=np.zeros((width, width)),
            camera_prior_rhs=np.zeros(width),
        ),
        projection.depth,
    )
