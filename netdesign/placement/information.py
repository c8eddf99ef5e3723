"""How much one image can tell at most, over whole cells of the admissible stations (kernels of ``bound``).

With u the direction of the camera from the centre that it looks at, R its distance from there, p an object point
relative to it, w = |p|, d = p - R u and z = R - u·p, an image adds to the point's normal matrix (any roll)

    M(u, R) = omega / z⁴ · (|d|² I - d dᵀ - (p x u)(p x u)ᵀ),        omega = (focal · gain / sigma)²

For a symmetric Z and Y = Z², tr(Z M Z) = omega · A / z⁴ with the quadratic A(u) = a + b·u - uᵀ C u,

    a = (w² + R²) tr Y - pᵀ Y p,    b = 2 R (Y - tr Y) p,    C = R² Y + K,    K = [p]ₓᵀ Y [p]ₓ.

Width of a cell: along a great circle (|u'| = 1, u'' = -u) the second derivative of A / z⁴ is at most

    ((|b| + 2 c) + 8 (|b| + c) w / z + tr Y (R + w)² (20 w² / z² + 4 w / z)) / z⁴,   z the least there,  c = ‖C‖,

so a cell whose directions lie within delta of its middle admits at most value + |gradient| delta + curvature
delta² / 2, gradients added over the points before the norm is taken.

Depth of a cell: along a ray, with q the part of p across u and y = uᵀYu, A / z⁴ = (tr Y - y) / z² + 2 qᵀYu / z³ +
y |q|² / z⁴. As Y is positive, the middle term is at most twice the geometric mean of the other two, and the second
derivative is at least -1.2 (tr Y - y) / z⁴. So the sum over the points is nowhere on a ray more than at the nearer or
at the farther end, plus 0.6 e² Σ omega tr Y / z⁴ with e half the depth of the cell.

gain and sigma enter by their best in the cell.
"""

import math

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.compiled import entry
from netdesign.placement.sighting_weight import gain, tangent
from netdesign.placement.visibility_cells import Words


@entry()
def most_information(
    directions: Floats, depths: Floats, deltas: Floats, bits: Words, points: Floats, normals: Floats, squares: Floats,
    gains: Floats, sigmas: Floats,
) -> Floats:  # fmt: skip
    """Return (c, 3): an upper bound of h over every station of each cell, and what its width and its depth add to it.

    Args:
        directions: (c, 3) unit, to the middle of each cell.  depths: (c, 2) least and largest R, m.
        deltas: (c,) largest angle of a direction of the cell from its middle, rad.
        bits: (c, words) of the tags that count.
        points, normals: (m, 3), points relative to the centre.
        squares: (m, 21) of ``quadratic_forms``.
        gains, sigmas: as in ``weight``.
    """
    result = np.zeros((len(directions), 3))
    varying, curved = sigmas.shape[0] > 1, len(gains) > 2
    for cell in range(len(directions)):
        ux, uy, uz = directions[cell, 0], directions[cell, 1], directions[cell, 2]
        near, far, delta = depths[cell, 0], depths[cell, 1], deltas[cell]
        middle, half, sine = 0.5 * (near + far), 0.5 * (far - near), 2.0 * math.sin(0.5 * delta)
        ends = 2 if far > near else 1
        sums = np.zeros((2, 5))  # value, gradient, what is added to them, at either end
        bend, deep, reached = 0.0, 0.0, False
        for tag in range(len(points) // 4):
            if not (bits[cell, tag >> 6] >> np.uint64(tag & 63)) & np.uint64(1):
                continue
            for j in range(4 * tag, 4 * tag + 4):
                px, py, pz = points[j, 0], points[j, 1], points[j, 2]
                size, along = squares[j, 0], ux * px + uy * py + uz * pz
                lowest = near - along - size * sine
                if lowest <= 0.0:
                    reached = True
                    continue
                best = 1.0
                if curved:
                    lateral = math.sqrt(max(size * size - along * along, 0.0))
                    best = gain(lowest, middle - along, lateral, size * sine, half, gains)
                # omega = scale + (wx wy wz) · u + rest, at most; its linear part changes by lean at most
                scale, rest, late, lean, wx, wy, wz = best * sigmas[0, 0, 0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                if varying:
                    square = size * size + near * near - 2.0 * near * along
                    away = math.sqrt(square)
                    nearest = max(away - near * sine, lowest)
                    nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
                    cosine = (near * (ux * nx + uy * ny + uz * nz) - (px * nx + py * ny + pz * nz)) / away
                    fx = near * (nx / away + cosine * px / square)
                    fy = near * (ny / away + cosine * py / square)
                    fz = near * (nz / away + cosine * pz / square)
                    radial = fx * ux + fy * uy + fz * uz
                    slope = math.sqrt(max(fx * fx + fy * fy + fz * fz - radial * radial, 0.0)) * delta
                    turn = 0.5 * (2.0 + 3.0 * near / nearest) * near / nearest * delta * delta
                    slide = 2.0 * half * size / (nearest * nearest)
                    z = near - along
                    scale, by_cosine, by_depth, rest = tangent(
                        z, lowest, cosine, slope + turn + slide, slope, size * delta / z, sigmas
                    )
                    by_depth /= z
                    late = abs(by_cosine) * slide + rest * slide / (slope + turn + slide + 1e-300)
                    fall = 0.5 * size * (z + size) * z / (lowest * lowest) * delta * delta
                    rest += abs(by_cosine) * (turn + slide) + abs(by_depth) * fall
                    wx, wy = by_cosine * fx - by_depth * px, by_cosine * fy - by_depth * py
                    wz = by_cosine * fz - by_depth * pz
                    radial = wx * ux + wy * uy + wz * uz
                    lean = math.sqrt(max(wx * wx + wy * wy + wz * wz - radial * radial, 0.0)) * delta
                    scale, rest, late, lean = best * scale, best * rest, best * late, best * lean
                    wx, wy, wz = best * wx, best * wy, best * wz
                trace, constant = squares[j, 1], squares[j, 2]
                gx, gy, gz = squares[j, 3], squares[j, 4], squares[j, 5]
                yx = squares[j, 6] * ux + squares[j, 7] * uy + squares[j, 8] * uz
                yy = squares[j, 7] * ux + squares[j, 9] * uy + squares[j, 10] * uz
                yz = squares[j, 8] * ux + squares[j, 10] * uy + squares[j, 11] * uz
                kx = squares[j, 12] * ux + squares[j, 13] * uy + squares[j, 14] * uz
                ky = squares[j, 13] * ux + squares[j, 15] * uy + squares[j, 16] * uz
                kz = squares[j, 14] * ux + squares[j, 16] * uy + squares[j, 17] * uz
                linear = gx * ux + gy * uy + gz * uz
                y, k = yx * ux + yy * uy + yz * uz, kx * ux + ky * uy + kz * uz
                for end in range(ends):
                    r = near if end == 0 else far
                    inverse = 1.0 / (r - along)
                    factor = inverse * inverse * inverse * inverse
                    a = constant + r * r * (trace - y) + 2.0 * r * linear - k
                    steep = 4.0 * a * inverse
                    value = factor * a
                    dx = factor * (2.0 * (r * gx - r * r * yx - kx) + steep * px)
                    dy = factor * (2.0 * (r * gy - r * r * yy - ky) + steep * py)
                    dz = factor * (2.0 * (r * gz - r * r * yz - kz) + steep * pz)
                    inverse = 1.0 / (r - along - size * sine)
                    ratio = size * inverse
                    slope, norm = 2.0 * r * squares[j, 18], r * r * squares[j, 19] + squares[j, 20]
                    curve = 0.5 * delta * delta * inverse * inverse * inverse * inverse * (
                        slope + 2.0 * norm + 8.0 * (slope + norm) * ratio
                        + trace * (r + size) ** 2 * (20.0 * ratio * ratio + 4.0 * ratio)
                    )  # fmt: skip
                    sums[end, 0] += scale * value
                    sums[end, 1] += scale * dx + value * wx
                    sums[end, 2] += scale * dy + value * wy
                    sums[end, 3] += scale * dz + value * wz
                    sums[end, 4] += scale * curve
                    if varying:
                        radial = dx * ux + dy * uy + dz * uz
                        change = math.sqrt(max(dx * dx + dy * dy + dz * dz - radial * radial, 0.0)) * delta + curve
                        sums[end, 4] += rest * (value + change) + lean * change
                        if end == 0:
                            deep += late * value
                inverse = 1.0 / lowest
                bend += (scale + lean + rest) * trace * inverse * inverse * inverse * inverse
        bend *= 0.6 * half * half
        highest, width = 0.0, 0.0
        for end in range(ends):
            radial = sums[end, 1] * ux + sums[end, 2] * uy + sums[end, 3] * uz
            slope = sums[end, 1] ** 2 + sums[end, 2] ** 2 + sums[end, 3] ** 2 - radial * radial
            added = math.sqrt(max(slope, 0.0)) * delta + sums[end, 4]
            highest, width = max(highest, sums[end, 0] + added), max(width, added)
        result[cell, 0], result[cell, 1], result[cell, 2] = highest + bend, width - deep, bend + deep
        if reached:  # the cell's stations come too near for a bound
            result[cell, 0] = np.inf
    return result


def quadratic_forms(squares: Floats, points: Floats) -> Floats:
    """Return (m, 21): w; tr Y; w² tr Y - pᵀYp; (Y - tr Y) p; Y and K as xx xy xz yy yz zz; the norms of the last three.

    Args:
        squares: (m, 3, 3) Y = Z².  points: (m, 3) relative to the centre.
    """
    trace, size = np.trace(squares, axis1=1, axis2=2), np.linalg.norm(points, axis=1)
    image = np.einsum("mij,mj->mi", squares, points)
    linear = image - trace[:, None] * points
    # Columns of [p]ₓ are p x e_k, so that p x u = [p]ₓ u.
    cross = np.cross(points[:, None, :], np.eye(3)[None]).swapaxes(1, 2)
    turned = np.einsum("mki,mkl,mlj->mij", cross, squares, cross)
    upper = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
    columns = [size, trace, trace * size**2 - np.einsum("mi,mi->m", points, image), linear, squares[:, *upper]]
    columns += [turned[:, *upper], np.linalg.norm(linear, axis=1)]
    columns += [np.linalg.norm(matrices, axis=(1, 2), ord=2) for matrices in (squares, turned)]
    return np.ascontiguousarray(np.column_stack(columns))
