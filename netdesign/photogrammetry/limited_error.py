"""Limited error propagation: the covariance of each object point when the poses are error-free.

Every image that sees a point adds its observation equations to the point's own 3x3 normal matrix:

    N_j = Σ_i J_ijᵀ J_ij / sigma_ij²,      Q_j = N_j⁻¹,      f1 = Σ_j tr Q_j / 3m

("limiting error propagation" in the photogrammetric literature; equation 2 of the source paper.) Three forms:

* :func:`limited_covariance`: numpy, any pose, with distortion. The reference, and what is reported.
* :func:`direct_covariance`: the same, compiled.
* the moment form, for the search: undistorted cameras that look at the centre of a sphere of radius R. With u the
  direction of the camera from the centre and P the point relative to it, z = R - u·P and

      Jᵀ J = f² / z⁴ · (|d|² I - d dᵀ - (P × u)(P × u)ᵀ),   d = P - R u

  does not depend on the roll and is linear in the camera's products, so that nine sums per point are enough:
  s = weight / z⁴, S_u += s u (3), S_uu += s u uᵀ (6), and Σ s = tr S_uu. N follows once per point.
"""

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import FAST, entry, part
from netdesign.photogrammetry.collinearity import project_with_jacobians

SINGULAR = 1e-13
"""det N / (tr N)³ below which a point counts as undetermined: its rays are parallel to rounding."""

WEAK = 1e-6
"""det N / (tr N)³ below which the search refuses a point: two rays that meet at less than about 0.4 degrees."""


def limited_covariance(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats | float
) -> Floats:
    """Return the covariance (m, 3, 3) in m² of every object point; inf where the rays do not determine it.

    Args:
        world_from_cam: (n, 4, 4) m.  points: (m, 3) m.  intrinsics: (8,).
        visible: (n, m) which image sees which point.  sigma_px: one sigma, or (n, m).
    """
    derivative = project_with_jacobians(world_from_cam[:, None], points[None], intrinsics).d_xy_d_point
    weight = np.where(visible, 1.0 / np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), visible.shape) ** 2, 0.0)
    derivative = np.where(visible[..., None, None], derivative, 0.0)
    normal = np.einsum("nm,nmri,nmrj->mij", weight, derivative, derivative, optimize=True)
    return invert_normals(normal)


def invert_normals(normal: Floats) -> Floats:
    """Return the inverses (m, 3, 3) of normal matrices; inf where det N <= SINGULAR (tr N)³."""
    determined = conditioning(normal) > SINGULAR
    inverse = np.linalg.inv(np.where(determined[:, None, None], normal, np.eye(3)))
    inverse = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
    return np.where(determined[:, None, None], inverse, np.inf)


def variances_of(normal: Floats, least: float = SINGULAR) -> Floats:
    """Return the variances (…, m, 3) along x, y, z of normal matrices (…, m, 6), xx xy xz yy yz zz.

    inf where det N <= ``least`` (tr N)³.
    """
    xx, xy, xz, yy, yz, zz = np.moveaxis(normal, -1, 0)
    minors = np.stack([yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy], axis=-1)
    determinant = xx * minors[..., 0] + xy * (xz * yz - xy * zz) + xz * (xy * yz - xz * yy)
    determined = determinant > least * (xx + yy + zz) ** 3
    return np.where(determined[..., None], minors / np.where(determined, determinant, 1.0)[..., None], np.inf)


def conditioning(normal: Floats) -> Floats:
    """Return det N / (tr N)³ (m,) of matrices (m, 3, 3): 1/27 for isotropic points, 0 for undetermined ones."""
    trace = np.trace(normal, axis1=1, axis2=2)
    scaled = normal / np.where(trace > 0, trace, 1.0)[:, None, None]
    return np.where(trace > 0, np.linalg.det(scaled), 0.0)


@entry(fastmath=FAST)
def direct_covariance(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats
) -> Floats:
    """Return what :func:`limited_covariance` returns, compiled; ``sigma_px`` (n, m), or (1, 1) for one sigma."""
    images, count = visible.shape
    covariance = np.full((count, 3, 3), np.inf)
    fx, fy = intrinsics[0], intrinsics[1]
    k1, k2, p1, p2 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7]
    constant = sigma_px.size == 1
    for j in range(count):
        xx = xy = xz = yy = yz = zz = 0.0
        for i in range(images):
            if not visible[i, j]:
                continue
            pose = world_from_cam[i]
            d0, d1, d2 = points[j, 0] - pose[0, 3], points[j, 1] - pose[1, 3], points[j, 2] - pose[2, 3]
            depth = 1.0 / (pose[0, 2] * d0 + pose[1, 2] * d1 + pose[2, 2] * d2)
            a = (pose[0, 0] * d0 + pose[1, 0] * d1 + pose[2, 0] * d2) * depth
            b = (pose[0, 1] * d0 + pose[1, 1] * d1 + pose[2, 1] * d2) * depth
            r2 = a * a + b * b
            radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
            mixed = a * b * slope + 2.0 * (p1 * a + p2 * b)
            along = depth / (sigma_px[0, 0] if constant else sigma_px[i, j])
            ua, ub = fx * along * (radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a), fx * along * mixed
            va, vb = fy * along * mixed, fy * along * (radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a)
            uc, vc = -(ua * a + ub * b), -(va * a + vb * b)
            u0 = ua * pose[0, 0] + ub * pose[0, 1] + uc * pose[0, 2]
            u1 = ua * pose[1, 0] + ub * pose[1, 1] + uc * pose[1, 2]
            u2 = ua * pose[2, 0] + ub * pose[2, 1] + uc * pose[2, 2]
            v0 = va * pose[0, 0] + vb * pose[0, 1] + vc * pose[0, 2]
            v1 = va * pose[1, 0] + vb * pose[1, 1] + vc * pose[1, 2]
            v2 = va * pose[2, 0] + vb * pose[2, 1] + vc * pose[2, 2]
            xx += u0 * u0 + v0 * v0
            xy += u0 * u1 + v0 * v1
            xz += u0 * u2 + v0 * v2
            yy += u1 * u1 + v1 * v1
            yz += u1 * u2 + v1 * v2
            zz += u2 * u2 + v2 * v2
        c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        determinant, trace = xx * c00 + xy * c01 + xz * c02, xx + yy + zz
        if determinant > SINGULAR * trace * trace * trace:
            covariance[j, 0, 0], covariance[j, 1, 1] = c00 / determinant, (xx * zz - xz * xz) / determinant
            covariance[j, 2, 2] = (xx * yy - xy * xy) / determinant
            covariance[j, 0, 1] = covariance[j, 1, 0] = c01 / determinant
            covariance[j, 0, 2] = covariance[j, 2, 0] = c02 / determinant
            covariance[j, 1, 2] = covariance[j, 2, 1] = (xz * xy - xx * yz) / determinant
    return covariance


LANES = 16
"""Points per block of the moment form; within a block the rows of an array follow each other, LANES numbers each."""


def blocked(rows: Floats) -> Floats:
    """Return rows (k, m), one number per point, as one flat array of blocks (blocks, k, LANES); padded with zeros.

    All rows of a block lie at constant distances, so that the compiler sees that they do not overlap and vectorises.
    """
    count = -(-rows.shape[1] // LANES)
    padded = np.zeros((len(rows), count * LANES))
    padded[:, : rows.shape[1]] = rows
    return np.ascontiguousarray(padded.reshape(len(rows), count, LANES).transpose(1, 0, 2)).ravel()


WEIGHT, MOMENTS, VARIANCES, SPARE, ROWS = 3, 5, 14, 17, 18
"""Rows of a block at work: x, y, z; two rows of weights; xx, xy, xz, yy, yz, zz of S_uu and S_u; variances; spare.

All in one array: where rows of several arrays meet, the compiler has to prove or test that they do not overlap.
"""


@part(fastmath=FAST, allocates=False)
def add_two_cameras(
    block: Floats, ax: float, ay: float, az: float, bx: float, by: float, bz: float, radius: float,
    sign_a: float, sign_b: float,
) -> None:  # fmt: skip
    """Add two cameras, in the directions a and b of a sphere, to the moments of a block of points.

    Args:
        block: (ROWS * LANES,) changed in place. Its points are relative to the sphere's centre, m; its weights are 1 or
            1/sigma² where the camera sees the point, 0 where not.
        radius: R in m.  sign_a, sign_b: 1, -1 to take the camera away, 0 to leave it out.
    """
    for lane in range(LANES):
        p = np.uint64(lane)  # unsigned: a signed index is tested for < 0, which keeps the loop scalar
        x, y, z = block[p], block[p + np.uint64(LANES)], block[p + np.uint64(2 * LANES)]
        a, b = radius - (ax * x + ay * y + az * z), radius - (bx * x + by * y + bz * z)
        a, b = a * a, b * b
        a = sign_a * block[p + np.uint64(3 * LANES)] / (a * a)
        b = sign_b * block[p + np.uint64(4 * LANES)] / (b * b)
        a_x, a_y, a_z, b_x, b_y, b_z = a * ax, a * ay, a * az, b * bx, b * by, b * bz
        block[p + np.uint64(5 * LANES)] += a_x * ax + b_x * bx
        block[p + np.uint64(6 * LANES)] += a_x * ay + b_x * by
        block[p + np.uint64(7 * LANES)] += a_x * az + b_x * bz
        block[p + np.uint64(8 * LANES)] += a_y * ay + b_y * by
        block[p + np.uint64(9 * LANES)] += a_y * az + b_y * bz
        block[p + np.uint64(10 * LANES)] += a_z * az + b_z * bz
        block[p + np.uint64(11 * LANES)] += a_x + b_x
        block[p + np.uint64(12 * LANES)] += a_y + b_y
        block[p + np.uint64(13 * LANES)] += a_z + b_z


@part(fastmath=FAST, allocates=False)
def block_variances(block: Floats, radius: float, count: int) -> tuple[float, int]:
    """Write the variances of a block from its moments; return their sum and how many points are WEAK.

    Args:
        block: (ROWS * LANES,) as in :func:`add_two_cameras`; variances in units of 1 / f², m² when multiplied by
            sigma² / f² for unit weights.
        radius: R in m.
        count: points in the block; what pads it gets variance 0. Variances of WEAK points mean nothing.
    """
    weak, trace_sum = 0, 0.0
    square = radius * radius
    for lane in range(LANES):
        p = np.uint64(lane)
        x, y, z = block[p], block[p + np.uint64(LANES)], block[p + np.uint64(2 * LANES)]
        sxx, sxy, sxz = (
            block[p + np.uint64(5 * LANES)],
            block[p + np.uint64(6 * LANES)],
            block[p + np.uint64(7 * LANES)],
        )
        syy, syz, szz = (
            block[p + np.uint64(8 * LANES)],
            block[p + np.uint64(9 * LANES)],
            block[p + np.uint64(10 * LANES)],
        )
        sx, sy, sz = (
            block[p + np.uint64(11 * LANES)],
            block[p + np.uint64(12 * LANES)],
            block[p + np.uint64(13 * LANES)],
        )
        total = sxx + syy + szz
        # |d|² summed over the cameras; N = spread I - A - B with A the d dᵀ part, B = [P]x S_uu [P]xᵀ.
        spread = total * (x * x + y * y + z * z + square) - 2.0 * radius * (x * sx + y * sy + z * sz)
        a0, a1, a2 = y * sxz - z * sxy, y * syz - z * syy, y * szz - z * syz
        b0, b1, b2 = z * sxx - x * sxz, z * sxy - x * syz, z * sxz - x * szz
        c0, c1 = x * sxy - y * sxx, x * syy - y * sxy
        nxx = spread - (total * x * x - 2.0 * radius * x * sx + square * sxx) - (y * a2 - z * a1)
        nyy = spread - (total * y * y - 2.0 * radius * y * sy + square * syy) - (z * b0 - x * b2)
        nzz = spread - (total * z * z - 2.0 * radius * z * sz + square * szz) - (x * c1 - y * c0)
        nxy = radius * (x * sy + y * sx) - total * x * y - square * sxy - (z * a0 - x * a2)
        nxz = radius * (x * sz + z * sx) - total * x * z - square * sxz - (x * a1 - y * a0)
        nyz = radius * (y * sz + z * sy) - total * y * z - square * syz - (x * b1 - y * b0)
        cxx, cyy, czz = nyy * nzz - nyz * nyz, nxx * nzz - nxz * nxz, nxx * nyy - nxy * nxy
        determinant = nxx * cxx + nxy * (nxz * nyz - nxy * nzz) + nxz * (nxy * nyz - nxz * nyy)
        trace = nxx + nyy + nzz
        real = lane < count
        weak += int(real & (determinant <= WEAK * trace * trace * trace))
        scale = 1.0 / determinant if real else 0.0
        block[p + np.uint64(14 * LANES)] = cxx * scale if real else 0.0
        block[p + np.uint64(15 * LANES)] = cyy * scale if real else 0.0
        block[p + np.uint64(16 * LANES)] = czz * scale if real else 0.0
        trace_sum += (cxx + cyy + czz) * scale if real else 0.0
    return trace_sum, weak
