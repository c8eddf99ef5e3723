"""The largest weight omega = (focal · gain / sigma)² of a sighting over a cell of stations: tables, parts of kernels.

Sigma depends on the depth z of the point and on the cosine c of the incidence. Within a cell both are nearly linear in
the station, so that ``1 / sigma²`` is bounded by a tangent and half its largest second derivatives over the cell: the
best of every point by itself would be reached in different corners of the cell. Second derivatives come from
differences at the nodes of a table, and as much is added as they change to the next node. The distortion counts by its
largest gain, where a cell is too large for the tangent sigma by its smallest value.
"""

import math

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.compiled import part
from netdesign.photogrammetry.precision import corner_sigma

BINS = 64
WINDOWS = (2, 8, 24)  # bins about a node over which its second derivatives hold
SMALL = 1e-3  # of a bin: step of the differences


def gain_table(camera: Camera, outer: float) -> Floats:
    """Squared largest singular value of the distortion's Jacobian, at most, per step of the radius; last the step.

    The radial part stretches by 1 + 3 k1 s + 5 k2 s² along the radius and 1 + k1 s + k2 s² across; the tangential part
    by at most 6.4 (|p1| + |p2|) r. Polynomials in s change by at most their derivative within a step.
    """
    k1, k2, p1, p2 = camera.distortion.tolist()
    if not any((k1, k2, p1, p2)):
        return np.ones(2)
    radius = np.linspace(0.0, outer, 2001)
    square, step = radius**2, radius[1]
    along, across = np.abs(1 + 3 * k1 * square + 5 * k2 * square**2), np.abs(1 + k1 * square + k2 * square**2)
    change = (6 * abs(k1) * radius[1:] + 20 * abs(k2) * radius[1:] ** 3) * step
    largest = np.maximum(along, across)
    gain = np.maximum(largest[1:], largest[:-1]) + change + 6.4 * (abs(p1) + abs(p2)) * radius[1:]
    return np.append(gain**2, step)


def weight_table(camera: Camera, tag_size: float, depths: tuple[float, float], incidence: float) -> Floats:
    """Return (rows, columns, 4 + 3 w) of focal² / sigma² over bins of log depth and cosine; (1, 1, 1): constant.

    Of every bin the value in its middle, the derivatives there by cosine and log depth, the largest value of the bin,
    and for each of WINDOWS bounds of the second derivatives: cosine twice, log depth twice, mixed. The row after the
    last begins with the lowest depth, the height of a bin, the lowest cosine, the width of a bin.

    Args:
        depths: m, least and largest.  incidence: rad, the largest at which anything is seen.
    """
    focal = float(camera.focal_px.max())
    if camera.corner_noise is None:
        return np.full((1, 1, 1), focal**2 / camera.sigma_px**2)
    lowest = max(depths[0], depths[1] / 50.0)  # nearer ones get the largest value of all
    high, wide = math.log(depths[1] / lowest) / BINS, (1.0 - math.cos(incidence)) / BINS
    depth = math.log(lowest) + high * (np.arange(BINS) + 0.5)
    cosine = math.cos(incidence) + wide * (np.arange(BINS) + 0.5)
    scale = float(np.sqrt(camera.focal_px.prod())) * tag_size

    def value(down: float, right: float) -> Floats:
        edge, angle = scale / np.exp(depth + down * high), np.arccos(np.minimum(cosine + right * wide, 1.0))
        return np.asarray(focal**2 / corner_sigma(camera, edge[:, None], angle[None]) ** 2)

    h = SMALL
    middle, left, right, near, far = (value(*place) for place in ((0, 0), (0, -h), (0, h), (-h, 0), (h, 0)))
    mixed = value(h, h) - value(h, -h) - value(-h, h) + value(-h, -h)
    bends = (
        (right - 2 * middle + left) / wide**2,
        (far - 2 * middle + near) / high**2,
        np.abs(mixed) / 4 / wide / high,
    )
    largest = value(-0.5, 0.5)
    nearest = np.full(1, scale / max(depths[0], 1e-6))[:, None]
    largest[0] = focal**2 / corner_sigma(camera, nearest, np.arccos(np.minimum(cosine + 0.5 * wide, 1.0))[None]) ** 2
    layers = [middle, (right - left) / (2 * h * wide), (far - near) / (2 * h * high), largest]
    layers += [_highest(bend / h**2, window) for window in WINDOWS for bend in bends]
    table = np.stack(layers, axis=2)
    last = np.zeros((1, *table.shape[1:]))
    last[0, 0, :4] = lowest, high, math.cos(incidence), wide
    return np.ascontiguousarray(np.concatenate([table, last]))


def _highest(bend: Floats, window: int) -> Floats:
    """The largest second derivative within ``window`` bins, and one more, of every node; at least 0."""
    change = np.zeros_like(bend)
    for axis in (0, 1):
        steps = np.abs(np.diff(bend, axis=axis))
        for rows in (slice(1, None), slice(None, -1)):
            place = (rows, slice(None)) if axis == 0 else (slice(None), rows)
            change[place] = np.maximum(change[place], steps)
    high = np.maximum(bend + change, 0.0)
    for axis in (0, 1):
        width = [(window + 1, window + 1) if other == axis else (0, 0) for other in (0, 1)]
        padded = np.pad(high, width, mode="edge")
        high = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 3, axis=axis).max(axis=-1)
    return high


@part()
def gain(lowest: float, depth: float, lateral: float, moved: float, half: float, gains: Floats) -> float:
    """Return the largest squared gain of the distortion at a point over a cell.

    Args:
        lowest: least depth of the point, m.  depth, lateral: along and from the optical axis, in the middle, m.
        moved: how far the point moves in the camera's frame, m.  half: half the depth of the cell, m.
        gains: (b + 1,) of ``gain_table``.
    """
    r = lateral / depth
    shift = moved * math.sqrt(1.0 + r * r) / lowest
    shift += (r + shift) * half / lowest
    bins = len(gains) - 1
    first = min(max(int((r - shift) / gains[bins]), 0), bins - 1)
    last = min(max(int((r + shift) / gains[bins]), 0), bins - 1)
    best = gains[first]
    for k in range(first + 1, last + 1):
        best = max(best, gains[k])
    return float(best)


@part()
def tangent(
    depth: float, nearest: float, cosine: float, turned: float, lean: float, rise: float, table: Floats
) -> tuple[float, float, float, float]:
    """Return value, derivatives by cosine and log depth, and remainder: together at least focal² / sigma² over a cell.

    Args:
        depth: m, of the point, at the near end of the cell's middle.  nearest: the least over the cell.
        cosine: of its incidence, in the same place.  turned: how far it changes at most.
        lean, rise: the largest linear changes of cosine and log depth over the cell.
        table: of ``weight_table``.
    """
    rows, columns = table.shape[0] - 1, table.shape[1]
    lowest, high, least, wide = table[rows, 0, 0], table[rows, 0, 1], table[rows, 0, 2], table[rows, 0, 3]
    if nearest >= lowest:
        height = math.log(depth / lowest)
        row = min(int(height / high), rows - 1)
        column = min(max(int((cosine - least) / wide), 0), columns - 1)
        down, right = height - high * (row + 0.5), cosine - (least + wide * (column + 0.5))
        # Half of the range about the depth lies above it: there the logarithm changes most.
        dz, dc = math.log(depth / nearest) + abs(down), turned + abs(right)
        for level in range((table.shape[2] - 4) // 3):
            window = WINDOWS[level]
            if dz > window * high or dc > window * wide:
                continue
            by_cosine, by_depth = table[row, column, 1], table[row, column, 2]
            value = table[row, column, 0] + by_cosine * right + by_depth * down
            # The whole must not be negative where the point is not seen.
            if value < abs(by_cosine) * lean + abs(by_depth) * rise:
                break
            k = 4 + 3 * level
            rest = 0.5 * table[row, column, k] * dc * dc + 0.5 * table[row, column, k + 1] * dz * dz
            return value, by_cosine, by_depth, rest + table[row, column, k + 2] * dc * dz
    row = min(int(max(math.log(max(nearest / lowest, 1e-9)) / high, 0.0)), rows - 1)
    column = min(max(int((cosine + turned - least) / wide), 0), columns - 1)
    return table[row, column, 3], 0.0, 0.0, 0.0
