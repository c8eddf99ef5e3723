"""The image of a tag as the fit models it: exact cell coverage on a sub-pixel grid, blurred by a Gaussian.

A sub-pixel is a square of side h that the homography maps, to first order, to a parallelogram in tag coordinates.
Its coverage by a straight cell edge is the integral of a trapezoid (a box of width |du/dx| h convolved with one of
width |du/dy| h); coverages along u and along v are multiplied, exact for straight edges. Boxes of 1/h sub-pixels make
the pixel again, so that the pixel integration is exact and only the Gaussian is sampled.

On a tag that stands square to the pixel grid the trapezoid is a plain box, and its spectrum vanishes only to first
order where the sub-pixel grid folds back: edges would move by up to 0.02 px with their place in the pixel, all edges of
a direction alike. The nearer an edge is to the grid's axes, the more is its coverage smoothed by two further boxes,
and that much is taken out of the Gaussian (``further_box``, ``kernels``).

Kernels: arrays in, arrays out. Three layers are followed through the blur: white cells, the surround beyond the quiet
zone, and their sum weighted with the current grey levels, of which the derivatives are needed.
"""

import numpy as np
from numpy.typing import NDArray

from netdesign.model.arrays import Floats
from netdesign.model.compiled import FAST, entry, part

LEANING = 4.0  # an edge that leans by 1/LEANING against the grid needs no smoothing: its place in the pixel changes


def kernel_reach(sigma: float, per_pixel: int) -> int:
    """Return the sub-pixels beyond a pixel that ``kernels`` of a Gaussian up to ``sigma`` needs."""
    return int(np.ceil(4.5 * sigma * per_pixel))


def kernels(sigma: float, per_pixel: int, reach: int, smoothed: float = 0.0) -> Floats:
    """Return (3, 2 reach + per_pixel) taps: blur with pixel integration, its slope, its derivative by sigma.

    Applied to an image, the slope taps give the spatial derivative (per px) of the blurred image.

    Args:
        sigma: of the Gaussian, px.  per_pixel: sub-pixels along a pixel.  reach: from ``kernel_reach``.
        smoothed: variance, sub-pixels squared, that ``cover`` has smoothed by already.
    """
    x = np.arange(-reach, reach + 1) / per_pixel
    variance = max(sigma**2 - smoothed / per_pixel**2, 0.3 * sigma**2)
    bell = np.exp(-0.5 * x * x / variance)
    weight = bell / bell.sum()
    mean_square = float((weight * x * x).sum())
    rows = np.stack([weight, weight * x / variance, weight * (x * x - mean_square) * sigma / variance**2])
    box = np.full(per_pixel, 1.0 / per_pixel)
    return np.stack([np.convolve(row, box) for row in rows])


@part(fastmath=FAST)
def further_box(wide: float, narrow: float) -> float:
    """Return the width of the further boxes of an edge: ``wide`` on an edge along the grid, 0 on one that leans."""
    box = wide - LEANING * narrow
    return box if box > 0.05 * wide else 0.0


@part(fastmath=FAST)
def _once(t: float, wide: float, narrow: float) -> float:
    """Integral to t of the unit trapezoid that is flat to ±(wide - narrow)/2 and ends at ±(wide + narrow)/2."""
    outer = 0.5 * (wide + narrow)
    if t >= outer:
        return 1.0
    if t <= -outer:
        return 0.0
    inner = 0.5 * (wide - narrow)
    size = abs(t)
    if size <= inner:
        return 0.5 + t / wide
    rest = outer - size
    tail = 0.5 * rest * rest / (wide * narrow)
    return 1.0 - tail if t > 0 else tail


@part(fastmath=FAST)
def _thrice(t: float, wide: float, narrow: float) -> float:
    """Third integral to t of that trapezoid."""
    outer, inner = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    at_ramp, square_at_ramp = narrow * narrow * narrow / (24.0 * wide), narrow * narrow / (6.0 * wide)
    left = min(t, -t)
    below = 0.0
    if left > -inner:
        x = left + inner
        below = at_ramp + x * (square_at_ramp + x * (0.25 - (3.0 * inner - x) / (6.0 * wide)))
    elif left > -outer:
        tail = (left + outer) * (left + outer)
        below = tail * tail / (24.0 * wide * narrow)
    if t <= 0.0:
        return below
    middle = at_ramp + inner * (square_at_ramp + inner * (0.25 - inner / (3.0 * wide)))
    return float(2.0 * middle + 0.5 * t * t - below)


@part(fastmath=FAST)
def _smooth(t: float, wide: float, narrow: float, box: float) -> float:
    """Integral to t of that trapezoid convolved with two boxes of width ``box``."""
    if box == 0.0:
        return float(_once(t, wide, narrow))
    reach = 0.5 * (wide + narrow) + box
    if t >= reach:
        return 1.0
    if t <= -reach:
        return 0.0
    bent = _thrice(t + box, wide, narrow) - 2.0 * _thrice(t, wide, narrow) + _thrice(t - box, wide, narrow)
    return float(bent / (box * box))


@part(fastmath=FAST)
def _density(t: float, wide: float, narrow: float, box: float) -> float:
    """Density of that trapezoid and boxes at t, over a quarter of its width."""
    step = 0.125 * wide
    return float((_smooth(t + step, wide, narrow, box) - _smooth(t - step, wide, narrow, box)) / (2.0 * step))


@part(fastmath=FAST)
def _span(t: float, wide: float, narrow: float, box: float, shares: Floats) -> tuple[int, int]:
    """Fill ``shares`` with the shares of a sub-pixel centred at t in consecutive cells; return the first, how many."""
    half = 0.5 * (wide + narrow) + box
    first = int(np.floor(t - half))
    count = min(int(np.floor(t + half)) - first + 1, len(shares))
    before = 0.0
    for index in range(count - 1):
        upto = _smooth(first + index + 1.0 - t, wide, narrow, box)
        shares[index] = upto - before
        before = upto
    shares[count - 1] = 1.0 - before
    return first, count


@part(fastmath=FAST)
def _widest(grid_x: Floats, grid_y: Floats, m: Floats, axis: int, h: float) -> float:
    """Return a bound on how far from an edge, in cells, any sub-pixel of the grid may lie and still touch it.

    du/dx and du/dy are linear functions of x and y over the square of the homography's denominator: numerators and
    denominator are extreme at the grid's corners. A tenth is left for the lens.
    """
    low, high, depth_low = np.full(2, np.inf), np.full(2, -np.inf), np.inf
    for r in (0, grid_x.shape[0] - 1):
        for c in (0, grid_x.shape[1] - 1):
            x, y = grid_x[r, c], grid_y[r, c]
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2]
            at = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2]
            depth_low = min(depth_low, abs(depth))
            for k in range(2):
                slope = m[axis, k] * depth - at * m[2, k]
                low[k], high[k] = min(low[k], slope), max(high[k], slope)
    most_x, most_y = max(high[0], -low[0]), max(high[1], -low[1])
    least = max(min(max(low[0], -high[0]), max(low[1], -high[1])), 0.0)
    wide, narrow = max(most_x, most_y), min(most_x, most_y)
    reach = 0.5 * (wide + narrow) + max(wide - LEANING * least, 0.0)
    return float(1.1 * reach / (depth_low * depth_low) * h)


@entry(fastmath=FAST)
def cover(
    grid_x: Floats, grid_y: Floats, tag_from_px: Floats, cells: NDArray[np.uint8], h: float, layers: Floats
) -> None:
    """Fill ``layers`` (2, r, c) with white and surround coverage, smoothed, of every sub-pixel.

    Args:
        grid_x, grid_y: (r, c) undistorted pixel coordinates of the sub-pixel centres.
        tag_from_px: (3, 3) homography to cell coordinates.
        cells: (n, n) of the tag, 1 white.  h: side of a sub-pixel, ideal px.
    """
    rows, columns = grid_x.shape
    m, n = tag_from_px, len(cells)
    share_u, share_v = np.empty(6), np.empty(6)
    clear_u, clear_v = _widest(grid_x, grid_y, m, 0, h), _widest(grid_x, grid_y, m, 1, h)
    for r in range(rows):
        for c in range(columns):
            x, y = grid_x[r, c], grid_y[r, c]
            w = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * w
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * w
            column, row = int(np.floor(u)), int(np.floor(v))
            if clear_u < u - column < 1.0 - clear_u and clear_v < v - row < 1.0 - clear_v:
                beyond = row < -1 or row > n or column < -1 or column > n
                quiet = row == -1 or row == n or column == -1 or column == n
                layers[1, r, c] = 1.0 if beyond else 0.0
                layers[0, r, c] = 0.0 if beyond else (1.0 if quiet else float(cells[row, column]))
                continue
            ux, uy = abs(m[0, 0] - u * m[2, 0]) * abs(w) * h, abs(m[0, 1] - u * m[2, 1]) * abs(w) * h
            vx, vy = abs(m[1, 0] - v * m[2, 0]) * abs(w) * h, abs(m[1, 1] - v * m[2, 1]) * abs(w) * h
            wide_u, narrow_u = max(ux, uy, 1e-9), max(min(ux, uy), 1e-9)
            wide_v, narrow_v = max(vx, vy, 1e-9), max(min(vx, vy), 1e-9)
            box_u, box_v = further_box(wide_u, narrow_u), further_box(wide_v, narrow_v)
            first_u, count_u = _span(u, wide_u, narrow_u, box_u, share_u)
            first_v, count_v = _span(v, wide_v, narrow_v, box_v, share_v)
            white, outside = 0.0, 0.0
            for j in range(count_v):
                row = first_v + j
                for i in range(count_u):
                    column = first_u + i
                    share = share_u[i] * share_v[j]
                    if row < -1 or row > n or column < -1 or column > n:
                        outside += share
                    elif row == -1 or row == n or column == -1 or column == n or cells[row, column] == 1:
                        white += share
            if count_u > 1 and count_v > 1:
                # u and v vary together in a sub-pixel that the tag's tilt shears: E = uv-covariance x both densities.
                together = (
                    (m[0, 0] - u * m[2, 0]) * (m[1, 0] - v * m[2, 0])
                    + (m[0, 1] - u * m[2, 1]) * (m[1, 1] - v * m[2, 1])
                ) * (w * w * h * h / 12.0)
                for i in range(count_u - 1):
                    slope_u = _density(first_u + i + 1.0 - u, wide_u, narrow_u, box_u)
                    for j in range(count_v - 1):
                        slope_v = _density(first_v + j + 1.0 - v, wide_v, narrow_v, box_v)
                        extra = together * slope_u * slope_v
                        for k in range(4):
                            column, row = first_u + i + (k & 1), first_v + j + (k >> 1)
                            sign = 1.0 if k == 0 or k == 3 else -1.0
                            if row < -1 or row > n or column < -1 or column > n:
                                outside += sign * extra
                            elif row == -1 or row == n or column == -1 or column == n or cells[row, column] == 1:
                                white += sign * extra
            layers[0, r, c] = white
            layers[1, r, c] = outside


@entry(fastmath=FAST)
def blur(
    layers: Floats, taps: Floats, per_pixel: int, black: float, white: float, surround: float, out: Floats
) -> None:
    """Blur the layers and form the derivatives of the grey-level image.

    Args:
        layers: (2, r·s + 2 reach, c·s + 2 reach) from ``cover``.  taps: (3, taps) from ``kernels``, of that reach or
            a shorter one.
        out: (5, r, c) filled with: white share, surround share, and of the image black + (white - black)·white share
            + (surround - black)·surround share the derivatives along x, along y, and by sigma.
    """
    rows, columns = out.shape[1], out.shape[2]
    count, fine_columns = taps.shape[1], layers.shape[2]
    line = np.empty((4, fine_columns))
    up, beyond = white - black, surround - black
    skipped = (layers.shape[1] - (rows - 1) * per_pixel - count) // 2
    for r in range(rows):
        line[:] = 0.0
        for t in range(count):
            k0, k1, k2 = taps[0, t], taps[1, t], taps[2, t]
            source = r * per_pixel + skipped + t
            for c in range(fine_columns):
                a, b = layers[0, source, c], layers[1, source, c]
                mixed = up * a + beyond * b
                line[0, c] += k0 * a
                line[1, c] += k0 * b
                line[2, c] += k1 * mixed
                line[3, c] += k2 * mixed
        for c in range(columns):
            p = s = dx = dy = ds = 0.0
            for t in range(count):
                k0, k1, k2 = taps[0, t], taps[1, t], taps[2, t]
                at = c * per_pixel + skipped + t
                a, b = line[0, at], line[1, at]
                mixed = up * a + beyond * b
                p += k0 * a
                s += k0 * b
                dx += k1 * mixed
                dy += k0 * line[2, at]
                ds += k2 * mixed + k0 * line[3, at]
            out[0, r, c], out[1, r, c] = p, s
            out[2, r, c], out[3, r, c], out[4, r, c] = dx, dy, ds
