"""How much one image can tell at most, over whole cells of the viewing sphere (kernels of ``bound``).

With u the direction of the camera from the sphere's centre, p an object point relative to it, w = |p|, R the radius,
d = p - R u and z = R - u·p, an image that looks at the centre adds to the point's normal matrix (any roll)

    M(u) = omega / z⁴ · (|d|² I - d dᵀ - (p x u)(p x u)ᵀ),        omega = (focal · gain / sigma)²

For a symmetric Z and Y = Z², tr(Z M Z) = omega · A(u) / z⁴ with the quadratic A(u) = a + b·u + uᵀ C u,

    a = (w² + R²) tr Y - pᵀ Y p,    b = 2 R (Y - tr Y) p,    C = -R² Y - [p]ₓᵀ Y [p]ₓ.

Along a great circle (|u'| = 1, u'' = -u) the second derivative of A / z⁴ is at most

    ((|b| + 2 c) + 8 (|b| + c) w / z + tr Y (R + w)² (20 w² / z² + 4 w / z)) / z⁴,   z = R - w,  c = ‖C‖,

so a cell whose viewpoints lie within delta of its middle admits at most value + |gradient| delta + curvature
delta² / 2, gradients added over the points before the norm is taken. gain and sigma enter by their best in the cell.
"""

import math

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry, part
from netdesign.model.frames import sphere_directions
from netdesign.placement.visibility_cells import Words


@part()
def weight(
    z: float, lateral: float, w: float, cosine: float, distance: float, radius: float, delta: float, gains: Floats,
    sigmas: Floats,
) -> float:  # fmt: skip
    """Return the largest omega of a point within ``delta`` of a viewpoint.

    Args:
        z, lateral: depth and distance from the optical axis, m.  cosine: of the incidence.  distance: m.
        gains: (b + 1,) squared gain of the distortion, at most, in equal steps of the radius; last: the step.
        sigmas: (y, x) focal² / sigma², at most, over depth and cosine; last row: lowest depth, step of the depth.
    """
    best = 1.0
    nearest = z - 2.0 * w * math.sin(0.5 * delta)
    if len(gains) > 2:
        r = lateral / z
        shift = 2.0 * w * math.sin(0.5 * delta) * math.sqrt(1.0 + r * r) / max(nearest, 1e-9)
        bins = len(gains) - 1
        first = min(max(int((r - shift) / gains[bins]), 0), bins - 1)
        last = min(max(int((r + shift) / gains[bins]), 0), bins - 1)
        best = gains[first]
        for k in range(first + 1, last + 1):
            best = max(best, gains[k])
    rows, columns = sigmas.shape[0] - 1, sigmas.shape[1]
    if rows == 1:
        return float(best * sigmas[0, 0])
    sine = min(2.0 * radius * math.sin(0.5 * delta) / distance, 1.0)
    # cos(i - spread), at most 1
    steepest = 1.0
    if cosine < math.sqrt(1.0 - sine * sine):
        steepest = cosine * math.sqrt(1.0 - sine * sine) + math.sqrt(max(1.0 - cosine * cosine, 0.0)) * sine
    row = min(max(int((nearest - sigmas[rows, 0]) / sigmas[rows, 1]), 0), rows - 1)
    column = min(max(int(steepest * columns), 0), columns - 1)
    return float(best * sigmas[row, column])


def normal_matrices(
    viewpoints: Floats, visible: Bools, radius: float, points: Floats, normals: Floats, gains: Floats, sigmas: Floats
) -> Floats:
    """Return (c, m, 6): xx, xy, xz, yy, yz, zz of M for viewpoints (c, 2), 0 where not visible (c, m).

    Not a bound but the thing itself (up to the steps of the tables): it only guides the choice of Z.
    """
    u = sphere_directions(viewpoints)
    along = u @ points.T
    offset = points[None] - radius * u[:, None]
    across = np.cross(points[None], u[:, None])
    square, lateral = np.einsum("cmi,cmi->cm", offset, offset), np.linalg.norm(across, axis=2)
    z = radius - along
    scale = np.where(visible, 1.0 / z**4, 0.0)
    if len(gains) > 2:
        bins = len(gains) - 1
        scale *= gains[np.minimum((lateral / z / gains[bins]).astype(np.int64), bins - 1)]
    rows, columns = len(sigmas) - 1, sigmas.shape[1]
    cosine = np.clip(-np.einsum("cmi,mi->cm", offset, normals) / np.sqrt(square), 0.0, 1.0)
    step = sigmas[rows, 1] if rows > 1 else 1.0
    row = np.clip((z - sigmas[rows, 0]) / step, 0, rows - 1).astype(np.int64)
    scale *= sigmas[row, np.minimum((cosine * columns).astype(np.int64), columns - 1)]
    matrices = np.empty((*scale.shape, 6))
    for place, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        diagonal = square if i == j else 0.0
        matrices[..., place] = scale * (diagonal - offset[..., i] * offset[..., j] - across[..., i] * across[..., j])
    return matrices


@entry()
def largest_gains(
    cells: Ints, grid: Floats, parts: int, spreads: Floats, bits: Words, radius: float, points: Floats, normals: Floats,
    forms: Floats, gains: Floats, sigmas: Floats,
) -> Floats:  # fmt: skip
    """Return (c,) upper bounds of Σ tr(Z_j M_j(u) Z_j) over every viewpoint of each cell.

    Args:
        cells: (c,) of the map with ``grid``.  parts: every cell is cut into parts x parts, each bounded by itself.
        spreads: (rows, parts) delta of the parts of a row of cells.  bits: (cells, words) of the tags that count.
        points, normals: (m, 3), points relative to the sphere's centre.
        forms: (m, 11) a, b, the upper triangle of C, and the curvature of ``quadratic_forms``.
        gains, sigmas: as in ``weight``.
    """
    result = np.zeros(len(cells))
    columns = int(grid[2])
    for index in range(len(cells)):
        cell = cells[index]
        for piece in range(parts * parts):
            alpha = grid[0] + (cell % columns + (piece % parts + 0.5) / parts) / grid[1]
            beta = grid[3] + (cell // columns + (piece // parts + 0.5) / parts) / grid[4]
            ux, uy, uz = math.cos(beta) * math.cos(alpha), math.cos(beta) * math.sin(alpha), math.sin(beta)
            delta = spreads[cell // columns, piece // parts]
            value = curvature = gx = gy = gz = 0.0
            for tag in range(len(points) // 4):
                if not (bits[cell, tag >> 6] >> np.uint64(tag & 63)) & np.uint64(1):
                    continue
                for j in range(4 * tag, 4 * tag + 4):
                    px, py, pz = points[j, 0], points[j, 1], points[j, 2]
                    up = ux * px + uy * py + uz * pz
                    z = radius - up
                    cx = forms[j, 4] * ux + forms[j, 5] * uy + forms[j, 6] * uz
                    cy = forms[j, 5] * ux + forms[j, 7] * uy + forms[j, 8] * uz
                    cz = forms[j, 6] * ux + forms[j, 8] * uy + forms[j, 9] * uz
                    a = forms[j, 0] + forms[j, 1] * ux + forms[j, 2] * uy + forms[j, 3] * uz
                    a += cx * ux + cy * uy + cz * uz
                    scale = sigmas[0, 0]
                    if len(gains) > 2 or len(sigmas) > 2:
                        square = px * px + py * py + pz * pz
                        distance = math.sqrt(square + radius * radius - 2.0 * radius * up)
                        facing = radius * (ux * normals[j, 0] + uy * normals[j, 1] + uz * normals[j, 2])
                        facing -= px * normals[j, 0] + py * normals[j, 1] + pz * normals[j, 2]
                        lateral = math.sqrt(max(square - up * up, 0.0))
                        scale = weight(
                            z, lateral, math.sqrt(square), facing / distance, distance, radius, delta, gains, sigmas
                        )
                    inverse = 1.0 / z
                    scale *= inverse * inverse * inverse * inverse
                    steep = 4.0 * a * inverse
                    value += scale * a
                    gx += scale * (forms[j, 1] + 2.0 * cx + steep * px)
                    gy += scale * (forms[j, 2] + 2.0 * cy + steep * py)
                    gz += scale * (forms[j, 3] + 2.0 * cz + steep * pz)
                    curvature += scale * z**4 * forms[j, 10]
            radial = gx * ux + gy * uy + gz * uz
            slope = math.sqrt(max(gx * gx + gy * gy + gz * gz - radial * radial, 0.0))
            result[index] = max(result[index], value + slope * delta + 0.5 * curvature * delta * delta)
    return result


def quadratic_forms(squares: Floats, points: Floats, radius: float) -> Floats:
    """Return (m, 11): a, b (3), C as xx xy xz yy yz zz, and the bound on the second derivative, per point.

    Args:
        squares: (m, 3, 3) Y = Z².  points: (m, 3) relative to the sphere's centre.
    """
    trace = np.trace(squares, axis1=1, axis2=2)
    size = np.linalg.norm(points, axis=1)
    image = np.einsum("mij,mj->mi", squares, points)
    constant = trace * (size**2 + radius**2) - np.einsum("mi,mi->m", points, image)
    linear = 2.0 * radius * (image - trace[:, None] * points)
    # Columns of [p]ₓ are p x e_k, so that p x u = [p]ₓ u.
    cross = np.cross(points[:, None, :], np.eye(3)[None]).swapaxes(1, 2)
    quadratic = -(radius**2) * squares - np.einsum("mki,mkl,mlj->mij", cross, squares, cross)
    norm = np.linalg.norm(quadratic, axis=(1, 2), ord=2) if len(points) else np.zeros(0)
    depth = radius - size
    ratio = size / depth
    slope = np.linalg.norm(linear, axis=1)
    curvature = (
        slope
        + 2.0 * norm
        + 8.0 * (slope + norm) * ratio
        + trace * (radius + size) ** 2 * (20.0 * ratio**2 + 4.0 * ratio)
    ) / depth**4
    upper = quadratic[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return np.ascontiguousarray(np.column_stack([constant, linear, upper, curvature]))
