"""Eliminating the points from the normal equations of a free network, compiled.

A camera is moved by a twist (omega, tau) of the world about the points' centroid instead of its own axes. A point X
then moves in the camera as if it were moved by -(omega × X + tau), so with H (2, 3) the derivative of an image point
by X, its derivative by the camera is H [[X]ₓᵀ, I] (up to sign): everything follows from N = HᵀH (3, 3) of each image
point. With V = Σ_i N = L Lᵀ of a point over the images that see it,

    N_cc:  Σ_j [[X]ₓᵀ, I]ᵀ N [[X]ₓᵀ, I],      whitened: L⁻¹ N [[X]ₓᵀ, I],      solved: V⁻¹ N [[X]ₓᵀ, I].

The rows of such products stand in memory camera-side unknown by unknown, so that one symmetric product of matrices
reduces the normal equations. Loops run over short strips of points: constant strides let the compiler use vectors.
"""

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.compiled import FAST, entry, part

STRIP = 32  # points that are treated together
SINGULAR = 1e-12  # of det V / (tr V / 3)³: below it the rays of a point are parallel


@entry(fastmath=FAST)
def eliminate_points(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats, basis: Floats,
    whitened: Floats, solved: Floats, own: Floats, bordered: Floats,
) -> float:  # fmt: skip
    """Write the reduced equations' parts, return the trace Σ tr V⁻¹ (m²); inf where an image or a point is loose.

    Args:
        world_from_cam: (n, 4, 4) m.  points: (m, 3) m.  intrinsics: (8,).  visible: (n, m).
        sigma_px: (n, m) or (1, 1) for one sigma.  basis: (3m, c) linear functions of the points.
        whitened: (6n + c, 3, m) out: L⁻¹ N_pc, then L⁻¹ basis.  solved: (6n, 3, m) out: V⁻¹ N_pc.
        own: (n, 6, 6) out: diagonal blocks of N_cc.
        bordered: (6n, 6n) out: N_cc + G Gᵀ, G an orthonormal basis of the datum's null space; (0, 0) to leave it out.

    The camera-side unknowns are scaled so that N_cc has a diagonal of 1.
    """
    # One function and constant strides: only then does the compiler turn the loops over strips into vectors.
    images, count = visible.shape
    one_sigma = sigma_px.shape[0] == 1 and sigma_px.shape[1] == 1
    fx, fy, k1, k2, p1, p2 = intrinsics[0], intrinsics[1], intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7]
    strips = (count + STRIP - 1) // STRIP
    centre = np.zeros(3)
    for j in range(count):
        for axis in range(3):
            centre[axis] += points[j, axis] / count
    centred = np.zeros((strips, 3, STRIP))
    for j in range(count):
        for axis in range(3):
            centred[j // STRIP, axis, j % STRIP] = points[j, axis] - centre[axis]
    normal = np.empty((images, strips, 6, STRIP))
    summed = np.zeros((strips, 6, STRIP))
    strength = np.zeros(STRIP)
    scale = np.zeros((images, 6))
    for i in range(images):
        pose, n_cc = world_from_cam[i], own[i]
        r00, r01, r02, c0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3] - centre[0]
        r10, r11, r12, c1 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3] - centre[1]
        r20, r21, r22, c2 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3] - centre[2]
        behind = 0.0
        o00 = o10 = o11 = o20 = o21 = o22 = 0.0
        o30 = o31 = o32 = o40 = o41 = o42 = o50 = o51 = o52 = 0.0
        o33 = o43 = o44 = o53 = o54 = o55 = 0.0
        for strip in range(strips):
            first = strip * STRIP
            strength[:] = 0.0
            for a in range(min(STRIP, count - first)):
                if visible[i, first + a]:
                    strength[a] = 1.0 / (sigma_px[0, 0] if one_sigma else sigma_px[i, first + a])
            for a in range(STRIP):
                x0, x1, x2 = centred[strip, 0, a], centred[strip, 1, a], centred[strip, 2, a]
                d0, d1, d2 = x0 - c0, x1 - c1, x2 - c2
                depth = r02 * d0 + r12 * d1 + r22 * d2
                depth = depth if strength[a] > 0.0 else 1.0  # what is not seen counts with weight 0, wherever it is
                behind += 0.0 if depth > 0.0 else 1.0
                inverse = 1.0 / depth
                u, v = (r00 * d0 + r10 * d1 + r20 * d2) * inverse, (r01 * d0 + r11 * d1 + r21 * d2) * inverse
                r2 = u * u + v * v
                radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
                mixed = u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
                wx, wy = fx * strength[a] * inverse, fy * strength[a] * inverse
                a0, a1 = wx * (radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u), wx * mixed
                b0, b1 = wy * mixed, wy * (radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u)
                a2, b2 = -(a0 * u + a1 * v), -(b0 * u + b1 * v)
                g0, h0 = a0 * r00 + a1 * r01 + a2 * r02, b0 * r00 + b1 * r01 + b2 * r02
                g1, h1 = a0 * r10 + a1 * r11 + a2 * r12, b0 * r10 + b1 * r11 + b2 * r12
                g2, h2 = a0 * r20 + a1 * r21 + a2 * r22, b0 * r20 + b1 * r21 + b2 * r22
                n00, n01, n02 = g0 * g0 + h0 * h0, g0 * g1 + h0 * h1, g0 * g2 + h0 * h2
                n11, n12, n22 = g1 * g1 + h1 * h1, g1 * g2 + h1 * h2, g2 * g2 + h2 * h2
                normal[i, strip, 0, a], normal[i, strip, 1, a], normal[i, strip, 2, a] = n00, n01, n02
                normal[i, strip, 3, a], normal[i, strip, 4, a], normal[i, strip, 5, a] = n11, n12, n22
                summed[strip, 0, a] += n00
                summed[strip, 1, a] += n01
                summed[strip, 2, a] += n02
                summed[strip, 3, a] += n11
                summed[strip, 4, a] += n12
                summed[strip, 5, a] += n22
                y00, y10, y20 = x1 * n02 - x2 * n01, x2 * n00 - x0 * n02, x0 * n01 - x1 * n00  # [X]ₓ N
                y01, y11, y21 = x1 * n12 - x2 * n11, x2 * n01 - x0 * n12, x0 * n11 - x1 * n01
                y02, y12, y22 = x1 * n22 - x2 * n12, x2 * n02 - x0 * n22, x0 * n12 - x1 * n02
                o00 += x1 * y02 - x2 * y01
                o10 += x2 * y00 - x0 * y02
                o20 += x0 * y01 - x1 * y00
                o11 += x2 * y10 - x0 * y12
                o21 += x0 * y11 - x1 * y10
                o22 += x0 * y21 - x1 * y20
                o30 += y00
                o31 += y10
                o32 += y20
                o40 += y01
                o41 += y11
                o42 += y21
                o50 += y02
                o51 += y12
                o52 += y22
                o33 += n00
                o43 += n01
                o53 += n02
                o44 += n11
                o54 += n12
                o55 += n22
        n_cc[0, 0], n_cc[3, 3], n_cc[3, 0], n_cc[3, 1], n_cc[3, 2] = o00, o33, o30, o31, o32
        n_cc[1, 0], n_cc[1, 1], n_cc[4, 0], n_cc[4, 1], n_cc[4, 2] = o10, o11, o40, o41, o42
        n_cc[2, 0], n_cc[2, 1], n_cc[5, 0], n_cc[5, 1], n_cc[5, 2] = o20, o21, o50, o51, o52
        n_cc[2, 2], n_cc[4, 3], n_cc[4, 4], n_cc[5, 3], n_cc[5, 4] = o22, o43, o44, o53, o54
        n_cc[5, 5] = o55
        if behind > 0.0:
            return np.inf
        for a in range(6):
            if not n_cc[a, a] > 0.0:
                return np.inf
            scale[i, a] = 1.0 / np.sqrt(n_cc[a, a])
        for a in range(6):
            for b in range(a + 1):
                n_cc[a, b] *= scale[i, a] * scale[i, b]
                n_cc[b, a] = n_cc[a, b]
    if len(bordered):
        _border(world_from_cam, centre, own, scale, bordered)
    roots = np.zeros((strips, 6, STRIP))
    trace: float = _roots(summed, roots, basis, whitened[6 * images :])
    if not trace < np.inf:
        return np.inf
    block = np.empty((6, 3, STRIP))
    for i in range(images):
        f0, f1, f2, f3, f4, f5 = scale[i, 0], scale[i, 1], scale[i, 2], scale[i, 3], scale[i, 4], scale[i, 5]
        for strip in range(strips):
            first = strip * STRIP
            for a in range(STRIP):
                x0, x1, x2 = centred[strip, 0, a], centred[strip, 1, a], centred[strip, 2, a]
                n00, n01, n02 = normal[i, strip, 0, a], normal[i, strip, 1, a], normal[i, strip, 2, a]
                n11, n12, n22 = normal[i, strip, 3, a], normal[i, strip, 4, a], normal[i, strip, 5, a]
                t00, t10, t11 = roots[strip, 0, a], roots[strip, 1, a], roots[strip, 2, a]
                t20, t21, t22 = roots[strip, 3, a], roots[strip, 4, a], roots[strip, 5, a]
                p00, p01, p02 = t00 * n00, t00 * n01, t00 * n02
                p10, p11, p12 = t10 * n00 + t11 * n01, t10 * n01 + t11 * n11, t10 * n02 + t11 * n12
                p20, p21 = t20 * n00 + t21 * n01 + t22 * n02, t20 * n01 + t21 * n11 + t22 * n12
                p22 = t20 * n02 + t21 * n12 + t22 * n22
                block[0, 0, a], block[0, 1, a] = f0 * (x1 * p02 - x2 * p01), f0 * (x1 * p12 - x2 * p11)
                block[1, 0, a], block[1, 1, a] = f1 * (x2 * p00 - x0 * p02), f1 * (x2 * p10 - x0 * p12)
                block[2, 0, a], block[2, 1, a] = f2 * (x0 * p01 - x1 * p00), f2 * (x0 * p11 - x1 * p10)
                block[0, 2, a], block[1, 2, a] = f0 * (x1 * p22 - x2 * p21), f1 * (x2 * p20 - x0 * p22)
                block[2, 2, a] = f2 * (x0 * p21 - x1 * p20)
                block[3, 0, a], block[3, 1, a], block[3, 2, a] = f3 * p00, f3 * p10, f3 * p20
                block[4, 0, a], block[4, 1, a], block[4, 2, a] = f4 * p01, f4 * p11, f4 * p21
                block[5, 0, a], block[5, 1, a], block[5, 2, a] = f5 * p02, f5 * p12, f5 * p22
            for k in range(6):
                row = 6 * i + k
                for a in range(min(STRIP, count - first)):
                    b0, b1, b2 = block[k, 0, a], block[k, 1, a], block[k, 2, a]
                    t00, t10, t11 = roots[strip, 0, a], roots[strip, 1, a], roots[strip, 2, a]
                    t20, t21, t22 = roots[strip, 3, a], roots[strip, 4, a], roots[strip, 5, a]
                    whitened[row, 0, first + a] = b0
                    whitened[row, 1, first + a] = b1
                    whitened[row, 2, first + a] = b2
                    solved[row, 0, first + a] = t00 * b0 + t10 * b1 + t20 * b2
                    solved[row, 1, first + a] = t11 * b1 + t21 * b2
                    solved[row, 2, first + a] = t22 * b2
    return trace


@part(fastmath=FAST)
def _roots(summed: Floats, roots: Floats, basis: Floats, whitened: Floats) -> float:
    """Write L⁻¹ of every point and L⁻¹ basis; return Σ tr V⁻¹, inf when a point is loose."""
    trace = 0.0
    for j in range(whitened.shape[2]):
        strip, a = j // STRIP, j % STRIP
        n00, n01, n02 = summed[strip, 0, a], summed[strip, 1, a], summed[strip, 2, a]
        n11, n12, n22 = summed[strip, 3, a], summed[strip, 4, a], summed[strip, 5, a]
        t00 = 1.0 / np.sqrt(n00)
        l10, l20 = n01 * t00, n02 * t00
        second = n11 - l10 * l10
        t11 = 1.0 / np.sqrt(second)
        l21 = (n12 - l20 * l10) * t11
        third = n22 - l20 * l20 - l21 * l21
        t22 = 1.0 / np.sqrt(third)
        if not (third > 0.0 and n00 * second * third > SINGULAR * ((n00 + n11 + n22) / 3.0) ** 3):
            return np.inf
        t10, t21 = -l10 * t00 * t11, -l21 * t11 * t22
        t20 = (l10 * l21 * t11 - l20) * t00 * t22
        trace += t00 * t00 + t10 * t10 + t11 * t11 + t20 * t20 + t21 * t21 + t22 * t22
        roots[strip, 0, a], roots[strip, 1, a], roots[strip, 2, a] = t00, t10, t11
        roots[strip, 3, a], roots[strip, 4, a], roots[strip, 5, a] = t20, t21, t22
        for g in range(basis.shape[1]):
            b0, b1, b2 = basis[3 * j, g], basis[3 * j + 1, g], basis[3 * j + 2, g]
            whitened[g, 0, j] = t00 * b0
            whitened[g, 1, j] = t10 * b0 + t11 * b1
            whitened[g, 2, j] = t20 * b0 + t21 * b1 + t22 * b2
    return trace


@part(fastmath=FAST)
def _border(world_from_cam: Floats, centre: Floats, own: Floats, scale: Floats, bordered: Floats) -> None:
    """Write N_cc + G Gᵀ.

    A motion of everything is the same twist for each camera, a change of scale moves each along its position. The six
    columns of the motion have no row in common, so that only the seventh needs to be made orthogonal.
    """
    images = len(own)
    gauge = np.zeros((6 * images, 7))
    for k in range(6):
        size = 0.0
        for i in range(images):
            size += 1.0 / scale[i, k] ** 2
        for i in range(images):
            gauge[6 * i + k, k] = 1.0 / (scale[i, k] * np.sqrt(size))
    size = 0.0
    for k in range(3, 6):
        shared = 0.0
        for i in range(images):
            gauge[6 * i + k, 6] = (world_from_cam[i, k - 3, 3] - centre[k - 3]) / scale[i, k]
            shared += gauge[6 * i + k, 6] * gauge[6 * i + k, k]
        for i in range(images):
            gauge[6 * i + k, 6] -= shared * gauge[6 * i + k, k]
            size += gauge[6 * i + k, 6] ** 2
    if size > 0.0:
        for row in range(6 * images):
            gauge[row, 6] /= np.sqrt(size)
    for row in range(6 * images):
        along = gauge[row, 6]
        for column in range(6 * images):
            bordered[row, column] = along * gauge[column, 6]
        for column in range(row % 6, 6 * images, 6):
            bordered[row, column] += gauge[row, row % 6] * gauge[column, row % 6]
        for k in range(6):
            bordered[row, row - row % 6 + k] += own[row // 6, row % 6, k]
