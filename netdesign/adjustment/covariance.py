"""Covariances of a solved adjustment in its datum.

Camera-side unknowns c, points p, g-inverse S⁻ and extended coupling B (rows of kept points are -I): in the gauge of S⁻

    c ~ S⁻,   p = d - B c,   d ~ D independent of c

and in the datum A = (G_pᵀ E G_p)⁻¹ G_pᵀ E of the chosen points:  c_E = c - G_c A p,  p_E = p - G_p A p.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.photogrammetry.normals import CameraSide, Reduced
from netdesign.photogrammetry.observation_equations import Layout


@dataclass(frozen=True, kw_only=True)
class DatumCovariance:
    """Covariances in one datum.

    Attributes:
        points: (m, 3, 3), 0 for fixed points.  camera: (W, W), tangent of the poses, free interior parameters.
        joint: (3m, 3m) or None.
    """

    points: Floats
    camera: Floats
    joint: Floats | None


def datum_covariance(
    reduced: Reduced,
    camera_side: CameraSide,
    layout: Layout,
    g_camera: Floats,
    g_points: Floats,
    operator: Floats,
    with_joint: bool,
) -> DatumCovariance:
    """Carry the covariances to the datum.

    Args:
        g_camera: (W, d), g_points: (3m, d): what is open.  operator: (d, 3m), A above.
    """
    count = len(layout.eliminated)
    coupling = reduced.coupling.with_kept(layout.kept_start)
    inverse = camera_side.inverse
    datum_part = coupling.under(operator)  # A B
    operator_blocks = operator.reshape(-1, count, 3).transpose(1, 0, 2)
    weighted = operator_blocks @ reduced.inverse  # (m, d, 3): A D
    inner = np.einsum("mai,mbi->ab", weighted, operator_blocks)  # A D Aᵀ
    g_blocks = g_points.reshape(count, 3, -1)
    # (B - G A B) S⁻ (B - G A B)ᵀ + (I - G A) D (I - G A)ᵀ, block by block.
    spread, product = coupling.spread(inverse, datum_part @ inverse)
    cross = g_blocks @ (weighted + np.swapaxes(product, 1, 2))
    inner_all = inner + datum_part @ inverse @ datum_part.T
    points = (
        spread + reduced.inverse - cross - np.swapaxes(cross, 1, 2)
        + np.einsum("mia,ab,mjb->mij", g_blocks, inner_all, g_blocks, optimize=True)
    )  # fmt: skip
    carry = np.eye(layout.width) + g_camera @ datum_part
    camera = carry @ inverse @ carry.T + g_camera @ inner @ g_camera.T
    joint = None
    if with_joint:
        moved = coupling.dense() - g_points @ datum_part
        joint = moved @ inverse @ moved.T
        index = np.arange(count)
        joint.reshape(count, 3, count, 3)[index, :, index, :] += reduced.inverse
        left = g_points @ weighted.transpose(1, 0, 2).reshape(-1, 3 * count)
        joint = joint - left - left.T + g_points @ inner @ g_points.T
        joint = 0.5 * (joint + joint.T)
    return DatumCovariance(
        points=0.5 * (points + np.swapaxes(points, 1, 2)), camera=0.5 * (camera + camera.T), joint=joint
    )
