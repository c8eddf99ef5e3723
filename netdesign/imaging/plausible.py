"""Whether pictures can be made at all: a camera whose image does not fold, stations outside the part."""

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import Part

ENCLOSED = 0.99  # of the full sphere; less inside an open shell, where a camera may well stand


def fold_radius_px(intrinsics: Floats) -> float:
    """Return how far from the principal point the radial distortion can carry an image point before it turns back, px.

    The first stationary point of r (1 + k1 r² + k2 r⁴); infinite if there is none.

    Args:
        intrinsics: (8,) fx, fy, cx, cy, k1, k2, p1, p2.
    """
    k1, k2 = (float(value) for value in intrinsics[4:6])
    roots = np.roots([5 * k2, 3 * k1, 1.0] if k2 else [3 * k1, 1.0] if k1 else [])
    squares = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
    if not squares:
        return float("inf")
    square = min(squares)
    return float(np.sqrt(square) * (1 + k1 * square + k2 * square**2) * intrinsics[:2].min())


def image_radius_px(camera: Camera) -> float:
    """Return the distance of the farthest corner of the image from the principal point, px."""
    size = np.array([camera.width_px, camera.height_px])
    return float(np.linalg.norm(np.maximum(camera.principal_point_px + 0.5, size - 0.5 - camera.principal_point_px)))


def enclosed(part: Part, positions: Floats) -> Bools:
    """Return which positions (n, 3) a closed surface surrounds: its solid angle there is the full sphere.

    Solid angle of a triangle: A. van Oosterom, J. Strackee, IEEE Trans. Biomed. Eng. 30(2), 1983.
    """
    turns = np.empty(len(positions))
    for index, position in enumerate(positions):
        a, b, c = np.moveaxis(part.triangles - position, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a)))
        turns[index] = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi)
    return np.asarray(np.abs(turns) > ENCLOSED)
