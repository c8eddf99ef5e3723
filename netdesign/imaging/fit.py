"""A tag's four corners from all its pixels: least squares between the picture and the tag's own image.

Unknowns: the four corners in ideal pixels (a homography), the grey levels of black, white and the surround, the
slope of the light in x and y, and sigma of the blur. Gauss-Newton with weights from the sensor's noise,
var = gain·level + floor: the inverse normal matrix is the covariance of the corners, 8 x 8, correlations included.

The derivative by a corner is the gradient of the model image times the motion of the image point that keeps its tag
coordinates. With the homography x = (h1 u + h2 v + h3)/(h7 u + h8 v + 1), y likewise, that motion is
(u, v, 1, -x u, -x v)/(h7 u + h8 v + 1) in the elements of h; sums over pixels are formed in h and carried over to the
corners with dh/dcorner at the end.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from netdesign.imaging.lens import ideal_pixels, measured_pixels
from netdesign.imaging.pattern import blur, cover, further_box, kernel_reach, kernels
from netdesign.model.arrays import Floats
from netdesign.model.compiled import FAST, entry

UNKNOWNS = 14  # 8 of geometry, black, white, surround, light slope x and y, sigma
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])  # corners of a tag of one cell
START_SIGMA_PX = 0.9
SURROUND_SIGMA = 0.3  # a priori, of the surround about white, in units of the contrast
SLOPE_SIGMA = 0.3  # a priori, of the light's slope over half a tag
CHOOSING = 4  # iterations that choose their pixels; later a pixel on the rim must not flicker in and out
SUBPIXELS = 2  # along a pixel: one alone leaves 0.002 px of systematic error, a fifth of a large tag's variance
NODES = 8  # per axis, of the lens's interpolation over a tag


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The result of one fit.

    Attributes:
        corners_px: (4, 2) measured pixels.  covariance_px2: (8, 8), order x0 y0 x1 y1 …; inf when not converged.
        chi2_per_dof: weighted residuals per degree of freedom; pixels: how many were used.
        black, white, surround: grey levels.  light_slope: (2,) relative change from the centre to the edge.
        sigma_px: blur.  bow: how far mid tones lie above the model, in units of the bow t (1 - t) of a tone t between
            black and white; 0 for a picture linear in light, only its sign and its zero mean something.
        converged: False when the corners still moved or the normal matrix was singular.
    """

    corners_px: Floats
    covariance_px2: Floats
    chi2_per_dof: float
    pixels: int
    black: float
    white: float
    surround: float
    light_slope: Floats
    sigma_px: float
    bow: float
    converged: bool
    iterations: int


def homography(corners: Floats, cells: int) -> tuple[Floats, Floats]:
    """Return px_from_tag (3, 3) through the four corners (4, 2) of a tag of ``cells`` cells along its edge.

    Also the derivative (8, 8) of its h1…h8 by the corners.
    """
    square = cells * SQUARE
    design, right = np.zeros((8, 8)), corners.reshape(8)
    for index, ((u, v), (x, y)) in enumerate(zip(square, corners, strict=True)):
        design[2 * index] = (u, v, 1, 0, 0, 0, -u * x, -v * x)
        design[2 * index + 1] = (0, 0, 0, u, v, 1, -u * y, -v * y)
    inverse: Floats = np.asarray(np.linalg.inv(design), np.float64)
    h: Floats = inverse @ right
    scale = square @ h[6:] + 1.0
    return np.append(h, 1.0).reshape(3, 3), np.asarray(inverse * np.repeat(scale, 2))


@entry(fastmath=FAST)
def _normal_equations(
    picture: Floats, centres: Floats, model: Floats, px_from_tag: Floats, tag_from_px: Floats, px_from_ideal: Floats,
    levels: Floats, frame: Floats, noise: Floats, inside: NDArray[np.bool_], choose: bool, normal: Floats,
    right: Floats,
) -> tuple[float, int]:  # fmt: skip
    """Sum the normal equations over the pixels of the tag and its inner rim.

    Args:
        picture: (r, c) grey levels.  centres: (r, c, 2) ideal pixels of the pixel centres.
        model: (5, r, c) from ``blur``.  px_from_ideal: (2, 2) derivative of measured by ideal pixels at the tag.
        levels: black, white, surround, slope x, slope y.
        frame: centre x, y and half size of the tag (ideal px), rim in cells, cells along the tag.  noise: gain, floor.
        inside: (r, c) pixels that take part; chosen anew from tag coordinates when ``choose``.

    Returns:
        Chi square and the number of pixels.
    """
    black, white, surround, slope_x, slope_y = levels
    h7, h8, m = px_from_tag[2, 0], px_from_tag[2, 1], tag_from_px
    rim, beyond = frame[3], frame[4] + frame[3]
    row = np.empty(14)
    normal[:] = 0.0
    right[:] = 0.0
    chi2, count = 0.0, 0
    for r in range(picture.shape[0]):
        for c in range(picture.shape[1]):
            x, y = centres[r, c, 0], centres[r, c, 1]
            scale = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
            u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * scale
            v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * scale
            if choose:
                inside[r, c] = -rim <= u <= beyond and -rim <= v <= beyond
            if not inside[r, c]:
                continue
            across, down = (x - frame[0]) / frame[2], (y - frame[1]) / frame[2]
            light = 1.0 + slope_x * across + slope_y * down
            a, s = model[0, r, c], model[1, r, c]
            base = black + (white - black) * a + (surround - black) * s
            gap = picture[r, c] - light * base
            weight = 1.0 / (noise[0] * max(light * base, 0.0) + noise[1])
            dx, dy = -light * model[2, r, c], -light * model[3, r, c]
            gx = dx * px_from_ideal[0, 0] + dy * px_from_ideal[1, 0]
            gy = dx * px_from_ideal[0, 1] + dy * px_from_ideal[1, 1]
            share = 1.0 / (h7 * u + h8 * v + 1.0)
            gx *= share
            gy *= share
            along = -(gx * x + gy * y)
            row[0], row[1], row[2] = gx * u, gx * v, gx
            row[3], row[4], row[5] = gy * u, gy * v, gy
            row[6], row[7] = along * u, along * v
            row[8], row[9], row[10] = light * (1.0 - a - s), light * a, light * s
            row[11], row[12], row[13] = across * base, down * base, light * model[4, r, c]
            chi2 += weight * gap * gap
            count += 1
            for i in range(14):
                scaled = weight * row[i]
                right[i] += scaled * gap
                for j in range(i, 14):
                    normal[i, j] += scaled * row[j]
    return chi2, count


class _Patch:
    """The pixels around one tag and their places in ideal pixels."""

    def __init__(self, picture: NDArray[np.generic], corners: Floats, intrinsics: Floats, rim_px: float,
                 sigma_limit: float) -> None:  # fmt: skip
        low = np.maximum(np.floor(corners.min(axis=0) - rim_px).astype(int), 0)
        high = np.minimum(np.ceil(corners.max(axis=0) + rim_px).astype(int) + 1, (picture.shape[1], picture.shape[0]))
        self.grey = np.asarray(picture[low[1] : high[1], low[0] : high[0]], np.float64)
        self.sigma_limit = sigma_limit
        self.reach = kernel_reach(sigma_limit, SUBPIXELS)
        size = high - low
        fine = [
            low[axis] - 0.5 + (np.arange(size[axis] * SUBPIXELS + 2 * self.reach) - self.reach + 0.5) / SUBPIXELS
            for axis in (0, 1)
        ]
        bent = bool(intrinsics[4:].any())
        self.fine = _grid(fine[0], fine[1], intrinsics, bent)
        pixel = [np.arange(low[axis], high[axis], dtype=np.float64) for axis in (0, 1)]
        self.centres = _grid(pixel[0], pixel[1], intrinsics, bent)
        self.layers = np.empty((2, *self.fine.shape[:2]))
        self.model = np.empty((5, *self.grey.shape))
        self.inside = np.zeros(self.grey.shape, np.bool_)


def _grid(x: Floats, y: Floats, intrinsics: Floats, bent: bool) -> Floats:
    """Return the (len(y), len(x), 2) ideal pixels of a grid of measured ones.

    The lens is smooth over a tag: the polynomials through NODES x NODES Chebyshev points stand for it.
    """
    if not bent:
        return np.stack(np.meshgrid(x, y), axis=-1)
    at_x, from_x = _interpolation(x)
    at_y, from_y = _interpolation(y)
    nodes = np.stack(np.meshgrid(at_x, at_y), axis=-1).reshape(-1, 2)
    values = ideal_pixels(nodes, intrinsics).reshape(NODES, NODES, 2)
    grid = np.empty((len(y), len(x), 2))
    for axis in (0, 1):
        grid[..., axis] = from_y @ values[..., axis] @ from_x.T
    return grid


def _interpolation(x: Floats) -> tuple[Floats, Floats]:
    """Return NODES Chebyshev points over the range of x (k,) and the (k, NODES) matrix from values there to x."""
    nodes = -np.cos((np.arange(NODES) + 0.5) * np.pi / NODES)
    middle, half = 0.5 * (x[0] + x[-1]), 0.5 * (x[-1] - x[0])
    at = chebyshev.chebvander((x - middle) / half, NODES - 1) @ np.linalg.inv(chebyshev.chebvander(nodes, NODES - 1))
    return middle + half * nodes, at


def _bow(patch: _Patch, levels: Floats, frame: Floats) -> float:
    """Return the bow of the tone curve that the residuals show.

    The residuals are orthogonal to everything that was estimated, so that their product with the bow vanishes when
    there is none, however much of it a shrunken tag could imitate.
    """
    black, white, surround, slope_x, slope_y = levels
    if white <= black:
        return 0.0
    away = (patch.centres - frame[:2]) / frame[2]
    light = 1.0 + slope_x * away[..., 0] + slope_y * away[..., 1]
    tone = patch.model[0] + patch.model[1] * (surround - black) / (white - black)
    shape = np.where(patch.inside, light * (white - black) * tone * (1.0 - tone), 0.0)
    gap = patch.grey - light * (black + (white - black) * tone)
    return float((shape * gap).sum() / max(float((shape * shape).sum()), 1e-12))


def _smoothed(corners: Floats) -> float:
    """Return by how much ``cover`` smooths the two directions of edges, mean variance in sub-pixels squared."""
    variance = 0.0
    for along in (corners[1] - corners[0], corners[3] - corners[0]):
        narrow, wide = np.sort(np.abs(along) / np.linalg.norm(along))
        variance += 2.0 * further_box(float(wide), float(narrow)) ** 2 / 12.0
    return 0.5 * variance


def fit_tag(
    picture: NDArray[np.generic], cells: NDArray[np.uint8], seed_px: Floats, intrinsics: Floats, gain: float,
    floor: float, max_iterations: int = 20, tolerance_px: float = 2e-4,
) -> Fit:  # fmt: skip
    """Fit one tag.

    Args:
        picture: (h, w) grey levels, linear in light.  cells: (n, n), 1 white.
        seed_px: (4, 2) corners to about a third of a cell, in the order of ``SQUARE``.  intrinsics: (8,).
        gain, floor: noise variance of a pixel is gain · level + floor, in grey levels².
    """
    corners = ideal_pixels(np.ascontiguousarray(seed_px, dtype=np.float64), intrinsics)
    edges = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    count = len(cells)
    cell = float(edges.mean()) / count
    rim = float(np.clip(1.6 / cell, 0.5, 0.9))  # cells of the quiet zone that take part: the blur's reach
    middle, half = corners.mean(axis=0), 0.5 * float(edges.mean())
    frame = np.array([*middle, half, rim, float(count)])
    _, px_from_ideal = measured_pixels(middle[None], intrinsics)
    patch = _Patch(picture, seed_px, intrinsics, rim * cell + 2.0, 1.2)
    dark, bright = np.quantile(patch.grey, [0.1, 0.9])
    contrast = max(float(bright - dark), 1.0)
    levels, sigma = np.array([dark, bright, bright, 0.0, 0.0]), START_SIGMA_PX
    normal, right = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    covariance, chi2, pixels, converged, iteration = np.full((14, 14), np.inf), np.inf, 0, False, 0
    # Sub-pixels under distortion are larger or smaller in ideal pixels by the lens's local scale.
    side = 1.0 / (SUBPIXELS * np.sqrt(abs(float(np.linalg.det(px_from_ideal[0])))))
    while iteration < max_iterations and not converged:
        iteration += 1
        px_from_tag, change = homography(corners, count)
        tag_from_px = np.linalg.inv(px_from_tag)
        cover(patch.fine[..., 0], patch.fine[..., 1], tag_from_px, cells, side, patch.layers)
        taps = kernels(sigma, SUBPIXELS, min(kernel_reach(sigma, SUBPIXELS), patch.reach), _smoothed(corners))
        blur(patch.layers, taps, SUBPIXELS, levels[0], levels[1], levels[2], patch.model)
        chi2, pixels = _normal_equations(
            patch.grey, patch.centres, patch.model, px_from_tag, tag_from_px, px_from_ideal[0], levels, frame,
            np.array([gain, floor]), patch.inside, iteration <= CHOOSING, normal, right,
        )  # fmt: skip
        to_corners = np.eye(UNKNOWNS)
        to_corners[:8, :8] = change
        full = np.triu(normal) + np.triu(normal, 1).T
        matrix, vector = to_corners.T @ full @ to_corners, to_corners.T @ right
        # The surround shows only in the blur's tail, the slopes not at all in a tiny tag: weak knowledge of both.
        matrix[10, 10] += 1.0 / (SURROUND_SIGMA * contrast) ** 2
        vector[10] += (levels[1] - levels[2]) / (SURROUND_SIGMA * contrast) ** 2
        for slope in (11, 12):
            matrix[slope, slope] += 1.0 / SLOPE_SIGMA**2
            vector[slope] -= levels[slope - 8] / SLOPE_SIGMA**2
        free = np.arange(UNKNOWNS) if iteration > 2 else np.arange(11)  # first the coarse shape
        try:
            covariance = np.linalg.inv(matrix[np.ix_(free, free)])
        except np.linalg.LinAlgError:
            break
        step = np.zeros(UNKNOWNS)
        step[free] = covariance @ vector[free]
        moved = float(np.abs(step[:8]).max())
        if not np.isfinite(covariance).all() or not np.isfinite(moved) or np.abs(corners - middle).max() > 6 * half:
            break
        corners = corners + step[:8].reshape(4, 2) * min(1.0, 0.5 * cell / max(moved, 1e-12))
        levels += step[8:13]
        levels[3:] = np.clip(levels[3:], -0.8, 0.8)
        sigma = float(np.clip(sigma + np.clip(step[13], -0.3, 0.3), 0.25, 6.0))
        if sigma > patch.sigma_limit:
            inside = patch.inside
            patch = _Patch(picture, seed_px, intrinsics, rim * cell + 2.0, 1.4 * sigma)
            patch.inside = inside
            continue
        converged = iteration > 3 and moved < tolerance_px
    measured, derivative = measured_pixels(corners, intrinsics)
    spread = np.zeros((8, 8))
    for index in range(4):
        spread[2 * index : 2 * index + 2, 2 * index : 2 * index + 2] = derivative[index]
    return Fit(
        corners_px=measured,
        covariance_px2=spread @ covariance[:8, :8] @ spread.T if converged else np.full((8, 8), np.inf),
        chi2_per_dof=chi2 / max(pixels - UNKNOWNS, 1), pixels=pixels, black=float(levels[0]), white=float(levels[1]),
        surround=float(levels[2]), light_slope=levels[3:].copy(), sigma_px=sigma, bow=_bow(patch, levels, frame),
        converged=converged, iterations=iteration,
    )  # fmt: skip
