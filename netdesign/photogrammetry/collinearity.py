"""The collinearity equations with OpenCV's k1, k2, p1, p2, and their derivatives.

Symbols: X object point, (R, t) the rotation and origin of world_from_cam, q the point in the camera frame,
(x, y) its normalised image coordinates, r² = x² + y².

    q  = Rᵀ (X - t),           x = q₁/q₃,  y = q₂/q₃,          g = 1 + k1 r² + k2 r⁴
    u  = cx + fx (x g + 2 p1 x y + p2 (r² + 2 x²))
    v  = cy + fy (y g + p1 (r² + 2 y²) + 2 p2 x y)

Pose tangent (GTSAM's): xi = (omega, v) in the camera frame, R' = R Exp(omega), t' = t + R v, hence
dq/domega = [q]ₓ, dq/dv = -I, dq/dX = Rᵀ. Source of the distortion model: D. C. Brown, Photogrammetric Engineering
37(8), 1971, in the parametrisation of OpenCV and GTSAM (Cal3DS2).
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.frames import skew

INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True, kw_only=True)
class Projection:
    """Image points and their derivatives; leading axes broadcast.

    Attributes:
        xy_px: (…, 2), origin at the centre of the top-left pixel.  depth: (…,) q₃; not positive = behind the camera.
        d_xy_d_pose: (…, 2, 6), rotation first.  d_xy_d_point: (…, 2, 3) px per length unit.
        d_xy_d_intrinsics: (…, 2, 8) with respect to fx, fy, cx, cy, k1, k2, p1, p2.
    """

    xy_px: Floats
    depth: Floats
    d_xy_d_pose: Floats
    d_xy_d_point: Floats
    d_xy_d_intrinsics: Floats


def in_camera(world_from_cam: Floats, points: Floats) -> Floats:
    """Return points (…, 3) of the world in the camera frame (…, 3)."""
    offset = points - world_from_cam[..., :3, 3]
    return np.asarray(np.einsum("...ji,...j->...i", world_from_cam[..., :3, :3], offset))


def distort(normalised: Floats, distortion: Floats) -> Floats:
    """Return distorted normalised coordinates (…, 2) for ideal ones (…, 2); distortion (…, 4) = k1, k2, p1, p2."""
    x, y = normalised[..., 0], normalised[..., 1]
    k1, k2, p1, p2 = (distortion[..., index] for index in range(4))
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + k2 * r2)
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def project(world_from_cam: Floats, points: Floats, intrinsics: Floats) -> tuple[Floats, Floats]:
    """Return (xy_px (…, 2), depth (…,)) of points (…, 3) seen by cameras (…, 4, 4) with intrinsics (…, 8).

    A depth that is not positive means that the point lies behind the camera and its image point means nothing;
    depth 0 gives inf or NaN coordinates, without a warning.
    """
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    q = in_camera(np.asarray(world_from_cam, dtype=np.float64), np.asarray(points, dtype=np.float64))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distorted = distort(q[..., :2] / q[..., 2:], intrinsics[..., 4:])
        return intrinsics[..., :2] * distorted + intrinsics[..., 2:4], q[..., 2]


def point_jacobians(world_from_cam: Floats, points: Floats, intrinsics: Floats) -> Floats:
    """Return d_xy_d_point (…, 2, 3) alone; arguments as for ``project``."""
    q = in_camera(world_from_cam, points)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return _d_xy_d_q(q, q[..., 0] / q[..., 2], q[..., 1] / q[..., 2], intrinsics) @ _transposed(world_from_cam)


def _d_xy_d_q(q: Floats, x: Floats, y: Floats, intrinsics: Floats) -> Floats:
    """(…, 2, 3) derivatives with respect to the point in the camera frame, by way of the normalised (x, y)."""
    fx, fy, _, _, k1, k2, p1, p2 = (intrinsics[..., index] for index in range(8))
    inverse_depth, r2 = 1.0 / q[..., 2], x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
    mixed = x * y * slope + 2 * p1 * x + 2 * p2 * y
    ux, uy = fx * (radial + x * x * slope + 2 * p1 * y + 6 * p2 * x), fx * mixed
    vx, vy = fy * mixed, fy * (radial + y * y * slope + 6 * p1 * y + 2 * p2 * x)
    rows = (
        (ux * inverse_depth, uy * inverse_depth, -(ux * x + uy * y) * inverse_depth),
        (vx * inverse_depth, vy * inverse_depth, -(vx * x + vy * y) * inverse_depth),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _transposed(world_from_cam: Floats) -> Floats:
    return np.swapaxes(world_from_cam[..., :3, :3], -1, -2)


def project_with_jacobians(world_from_cam: Floats, points: Floats, intrinsics: Floats) -> Projection:
    """Return image points with analytic derivatives; arguments as for ``project``."""
    world_from_cam = np.asarray(world_from_cam, dtype=np.float64)
    intrinsics = np.asarray(intrinsics, dtype=np.float64)
    q = in_camera(world_from_cam, np.asarray(points, dtype=np.float64))
    fx, fy, cx, cy, k1, k2, p1, p2 = (intrinsics[..., index] for index in range(8))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x, y = q[..., 0] / q[..., 2], q[..., 1] / q[..., 2]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + k2 * r2)
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        d_q = _d_xy_d_q(q, x, y, intrinsics)
        xy_px = np.stack([fx * xd + cx, fy * yd + cy], axis=-1)
        zero, one = np.zeros_like(xd), np.ones_like(xd)
        d_intrinsics = np.stack(
            [
                np.stack(
                    [xd, zero, one, zero, fx * x * r2, fx * x * r2**2, 2 * fx * x * y, fx * (r2 + 2 * x * x)], axis=-1
                ),
                np.stack(
                    [zero, yd, zero, one, fy * y * r2, fy * y * r2**2, fy * (r2 + 2 * y * y), 2 * fy * x * y], axis=-1
                ),
            ],
            axis=-2,
        )
        d_pose = np.concatenate([d_q @ skew(q), -d_q], axis=-1)
        d_point = d_q @ _transposed(world_from_cam)
    return Projection(
        xy_px=xy_px, depth=q[..., 2], d_xy_d_pose=d_pose, d_xy_d_point=d_point, d_xy_d_intrinsics=d_intrinsics
    )
