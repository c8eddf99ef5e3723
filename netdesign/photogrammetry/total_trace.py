"""Total error propagation as a search criterion: compiled, no (3m, 3m) matrix, no Python objects.

Same quantities as ``total_error.total_covariance`` for free poses and known interior orientation:

    trace Σ = tr D - tr QᵀDQ + tr S⁻ (BᵀB - UUᵀ),   U = BᵀQ
    variance of gᵀx = gᵀDg + uᵀS⁻u,   u = Bᵀg,      g projected to the datum

S⁻ comes from the Cholesky factor of the Jacobi-scaled S bordered by the datum's null space; a pivot that vanishes
means an undetermined network and gives inf. The block-diagonal middle takes each image by itself,

    tr D + Σ_i tr(S_ii⁻¹ (BᵀB)_ii),

at the cost of a few limited propagations: it sees an image that hangs loose, but not two groups of images that do.
"""

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import FAST, entry, part
from netdesign.photogrammetry.camera_side import datum_rows, image_by_image, invert, orthonormalise


@entry()
def total_trace(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats, basis: Floats
) -> float:
    """Return the trace (m²) of the joint covariance, inner constraints over all points; inf when not determined.

    Args:
        world_from_cam: (n, 4, 4) m.  points: (m, 3) m.  intrinsics: (8,).
        visible: (n, m).  sigma_px: (n, m) or (1, 1) for one sigma.
        basis: (3m, 7) from ``datum.inner_basis(points)``, once per object.
    """
    return float(propagated(world_from_cam, points, intrinsics, visible, sigma_px, basis, False)[0])


@entry()
def block_trace(world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats) -> float:
    """Return the block-diagonal middle between limited and total trace (m²); arguments as of :func:`total_trace`."""
    return float(propagated(world_from_cam, points, intrinsics, visible, sigma_px, np.zeros((0, 7)), True)[0])


@entry(fastmath=FAST)
def propagated(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats, basis: Floats,
    blocks: bool,
) -> Floats:  # fmt: skip
    """Return (1 + d,) the trace (m²) and the variances of d linear functions of the points; inf when not determined.

    Args:
        basis: (3m, 7 + d): the datum's basis, then the functions g, projected to it: orthogonal to the basis.
        blocks: only the trace, each image by itself; ``basis`` is then not read.
        Others: as of :func:`total_trace`.
    """
    images, count = visible.shape
    width, columns = 6 * images, 0 if blocks else basis.shape[1]
    undetermined = np.full(max(columns - 6, 1), np.inf)
    schur = np.zeros((width, width))
    spread = np.zeros((width, width))  # BᵀB
    turned = np.zeros((width, columns))  # U
    gauge_part = np.zeros((columns, columns))  # QᵀDQ
    scale = np.zeros(width)
    cross = np.zeros((images, 3, 6))
    solved = np.zeros((images, 3, 6))
    seen = np.zeros(images, dtype=np.int64)
    pose = np.zeros((2, 6))
    point = np.zeros((2, 3))
    inverse = np.zeros((3, 3))
    one_sigma = sigma_px.shape[0] == 1 and sigma_px.shape[1] == 1
    trace = 0.0
    for j in range(count):
        rays = 0
        n00 = n01 = n02 = n11 = n12 = n22 = 0.0
        for i in range(images):
            if not visible[i, j]:
                continue
            sigma = sigma_px[0, 0] if one_sigma else sigma_px[i, j]
            if not _derivatives(world_from_cam[i], points[j], intrinsics, 1.0 / sigma, pose, point):
                return undetermined
            seen[rays] = i
            for a in range(3):
                for b in range(6):
                    cross[rays, a, b] = point[0, a] * pose[0, b] + point[1, a] * pose[1, b]
            for a in range(6):
                for b in range(a + 1):
                    schur[6 * i + a, 6 * i + b] += pose[0, a] * pose[0, b] + pose[1, a] * pose[1, b]
            n00 += point[0, 0] ** 2 + point[1, 0] ** 2
            n01 += point[0, 0] * point[0, 1] + point[1, 0] * point[1, 1]
            n02 += point[0, 0] * point[0, 2] + point[1, 0] * point[1, 2]
            n11 += point[0, 1] ** 2 + point[1, 1] ** 2
            n12 += point[0, 1] * point[0, 2] + point[1, 1] * point[1, 2]
            n22 += point[0, 2] ** 2 + point[1, 2] ** 2
            rays += 1
        c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
        determinant = n00 * c00 + n01 * c01 + n02 * c02
        size = (n00 + n11 + n22) / 3.0
        if rays < 2 or not determinant > 1e-12 * size**3:
            return undetermined
        inverse[0, 0], inverse[0, 1], inverse[0, 2] = c00 / determinant, c01 / determinant, c02 / determinant
        inverse[1, 1], inverse[1, 2] = (n00 * n22 - n02 * n02) / determinant, (n01 * n02 - n00 * n12) / determinant
        inverse[2, 2] = (n00 * n11 - n01 * n01) / determinant
        inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
        trace += inverse[0, 0] + inverse[1, 1] + inverse[2, 2]
        for a in range(columns):
            for b in range(columns):
                if a != b and (a >= 7 or b >= 7):
                    continue
                value = 0.0
                for r in range(3):
                    for c in range(3):
                        value += basis[3 * j + r, a] * inverse[r, c] * basis[3 * j + c, b]
                gauge_part[a, b] += value
        for k in range(rays):
            for a in range(3):
                for b in range(6):
                    solved[k, a, b] = (
                        inverse[a, 0] * cross[k, 0, b] + inverse[a, 1] * cross[k, 1, b] + inverse[a, 2] * cross[k, 2, b]
                    )
            for b in range(6):
                row = 6 * seen[k] + b
                for g in range(columns):
                    turned[row, g] += (
                        solved[k, 0, b] * basis[3 * j, g]
                        + solved[k, 1, b] * basis[3 * j + 1, g]
                        + solved[k, 2, b] * basis[3 * j + 2, g]
                    )
        for k in range(rays):
            for other in range(k if blocks else 0, k + 1):
                for a in range(6):
                    row = 6 * seen[k] + a
                    for b in range(a + 1 if other == k else 6):
                        column = 6 * seen[other] + b
                        schur[row, column] -= (
                            cross[k, 0, a] * solved[other, 0, b]
                            + cross[k, 1, a] * solved[other, 1, b]
                            + cross[k, 2, a] * solved[other, 2, b]
                        )
                        spread[row, column] += (
                            solved[k, 0, a] * solved[other, 0, b]
                            + solved[k, 1, a] * solved[other, 1, b]
                            + solved[k, 2, a] * solved[other, 2, b]
                        )
    if blocks:
        return np.full(1, trace + image_by_image(schur, spread))
    for g in range(7):
        trace -= gauge_part[g, g]
    gauge = datum_rows(world_from_cam, points)
    for a in range(width):
        scale[a] = 1.0 / np.sqrt(schur[a, a]) if schur[a, a] > 0 else 0.0
        if scale[a] == 0.0:
            return undetermined
    if not orthonormalise(gauge, scale):
        return undetermined
    for a in range(width):
        for b in range(a + 1):
            schur[a, b] *= scale[a] * scale[b]
            for g in range(7):
                schur[a, b] += gauge[a, g] * gauge[b, g]
                spread[a, b] -= turned[a, g] * turned[b, g]
            spread[a, b] *= scale[a] * scale[b]
    if not invert(schur):
        return undetermined
    for a in range(width):
        trace += schur[a, a] * spread[a, a]
        for b in range(a):
            trace += 2.0 * schur[a, b] * spread[a, b]
    result = undetermined
    result[0] = trace if trace > 0 else np.inf
    for g in range(7, columns):
        value = gauge_part[g, g]
        for a in range(width):
            value += schur[a, a] * (scale[a] * turned[a, g]) ** 2
            for b in range(a):
                value += 2.0 * schur[a, b] * scale[a] * turned[a, g] * scale[b] * turned[b, g]
        result[g - 6] = value if value > 0 else np.inf
    return result


@part()
def _derivatives(
    world_from_cam: Floats, x: Floats, intrinsics: Floats, weight: float, pose: Floats, point: Floats
) -> bool:
    """Write the whitened derivatives of one image point to ``pose`` (2, 6) and ``point`` (2, 3); False if behind."""
    d0, d1, d2 = x[0] - world_from_cam[0, 3], x[1] - world_from_cam[1, 3], x[2] - world_from_cam[2, 3]
    q0 = world_from_cam[0, 0] * d0 + world_from_cam[1, 0] * d1 + world_from_cam[2, 0] * d2
    q1 = world_from_cam[0, 1] * d0 + world_from_cam[1, 1] * d1 + world_from_cam[2, 1] * d2
    q2 = world_from_cam[0, 2] * d0 + world_from_cam[1, 2] * d1 + world_from_cam[2, 2] * d2
    if not q2 > 0:
        return False
    k1, k2, p1, p2 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7]
    u, v, inverse_depth = q0 / q2, q1 / q2, 1.0 / q2
    r2 = u * u + v * v
    radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
    mixed = u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
    fx, fy = intrinsics[0] * weight * inverse_depth, intrinsics[1] * weight * inverse_depth
    a00, a01 = fx * (radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u), fx * mixed
    a10, a11 = fy * mixed, fy * (radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u)
    for row in range(2):
        g0, g1 = (a00, a01) if row == 0 else (a10, a11)
        g2 = -(g0 * u + g1 * v)
        pose[row, 0] = g1 * q2 - g2 * q1
        pose[row, 1] = g2 * q0 - g0 * q2
        pose[row, 2] = g0 * q1 - g1 * q0
        pose[row, 3], pose[row, 4], pose[row, 5] = -g0, -g1, -g2
        for axis in range(3):
            point[row, axis] = (
                g0 * world_from_cam[axis, 0] + g1 * world_from_cam[axis, 1] + g2 * world_from_cam[axis, 2]
            )
    return True
