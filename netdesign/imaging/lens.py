"""Between pixels as measured and ideal pixels, which a pinhole camera with the same K would show.

Straight lines are straight in ideal pixels, so a tag is a homography there. Brown's model with OpenCV's k1, k2, p1,
p2 is inverted by Newton's method; arrays in, arrays out.
"""

from typing import Any

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.compiled import FAST, entry, part


@part(fastmath=FAST)
def _bend(x: Any, y: Any, k: Floats) -> tuple[Any, Any, Any, Any, Any]:
    """Return distorted (x, y) of ideal normalised (x, y), numbers or arrays, and the derivatives xx, xy (= yx), yy."""
    k1, k2, p1, p2 = k[4], k[5], k[6], k[7]
    r2 = x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    mixed = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    along_x = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    along_y = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return bent_x, bent_y, along_x, mixed, along_y


@entry(fastmath=FAST)
def ideal_pixels(xy_px: Floats, intrinsics: Floats) -> Floats:
    """Return ideal pixels (k, 2) of measured ones (k, 2); neighbours in the list start each other's search."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    out = np.empty_like(xy_px)
    x, y = 0.0, 0.0
    for index in range(len(xy_px)):
        goal_x, goal_y = (xy_px[index, 0] - cx) / fx, (xy_px[index, 1] - cy) / fy
        if index == 0 or abs(goal_x - x) + abs(goal_y - y) > 0.3:
            x, y = goal_x, goal_y
        for _ in range(20):
            bent_x, bent_y, along_x, mixed, along_y = _bend(x, y, intrinsics)
            gap_x, gap_y = goal_x - bent_x, goal_y - bent_y
            determinant = along_x * along_y - mixed * mixed
            step_x = (along_y * gap_x - mixed * gap_y) / determinant
            step_y = (along_x * gap_y - mixed * gap_x) / determinant
            x += step_x
            y += step_y
            if abs(step_x) + abs(step_y) < 1e-8:  # quadratic: the next error is far below 1e-12
                break
        out[index, 0], out[index, 1] = x * fx + cx, y * fy + cy
    return out


def measured_pixels(ideal_px: Floats, intrinsics: Floats) -> tuple[Floats, Floats]:
    """Return measured pixels (k, 2) of ideal ones (k, 2) and their derivatives (k, 2, 2)."""
    fx, fy, cx, cy = intrinsics[:4]
    bent_x, bent_y, along_x, mixed, along_y = _bend((ideal_px[:, 0] - cx) / fx, (ideal_px[:, 1] - cy) / fy, intrinsics)
    measured = np.column_stack([fx * bent_x + cx, fy * bent_y + cy])
    derivative = np.stack([along_x, mixed * fx / fy, mixed * fy / fx, along_y], axis=-1).reshape(-1, 2, 2)
    return measured, derivative
