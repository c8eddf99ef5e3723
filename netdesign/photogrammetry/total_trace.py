"""Total error propagation as a search criterion: the trace only, no (3m, 3m) matrix, no objects.

Same quantities as ``total_error.total_covariance`` for free poses and known interior orientation:

    trace Σ = tr D - tr QᵀDQ + tr S⁻ (BᵀB - UUᵀ),   U = BᵀQ
    variance of gᵀx = gᵀDg + uᵀS⁻u,   u = Bᵀg,      g projected to the datum

``point_elimination`` writes B and R = L⁻¹ N_pc with D = L⁻ᵀL⁻¹; one symmetric product of [R; (L⁻¹Q)ᵀ] gives N_cc - S,
U and QᵀDQ at once, another one BᵀB, both at the speed of BLAS. S⁻ comes from the Cholesky factor of the scaled S
bordered by the datum's null space; a pivot that vanishes means an undetermined network and gives inf. The
block-diagonal middle takes each image by itself,

    tr D + Σ_i tr(S_ii⁻¹ (BᵀB)_ii),

at the cost of a few limited propagations: it sees an image that hangs loose, but not two groups of images that do.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import lapack

from netdesign.model.arrays import Bools, Floats
from netdesign.model.blas import one_blas_thread
from netdesign.photogrammetry.point_elimination import eliminate_points

LOOSE = 1e12
"""Variance of a camera-side unknown, in units of the one that it has with all points known, from which the network
counts as not determined. Rounding leaves an open unknown some 1e15. The smallest pivot of the factor would not do: it
is rounding too, but grown by the elimination, up to 1e-10."""


def total_trace(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats, basis: Floats
) -> float:
    """Return the trace (m²) of the joint covariance, inner constraints over all points; inf when not determined.

    Args:
        world_from_cam: (n, 4, 4) m.  points: (m, 3) m.  intrinsics: (8,).
        visible: (n, m).  sigma_px: (n, m) or (1, 1) for one sigma.
        basis: (3m, 7) from ``datum.inner_basis(points)``, once per object.
    """
    return float(propagated(world_from_cam, points, intrinsics, visible, sigma_px, basis)[0])


def block_trace(world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats) -> float:
    """Return the block-diagonal middle between limited and total trace (m²); arguments as of :func:`total_trace`."""
    with one_blas_thread():
        equations = _Reduced.of(world_from_cam, points, intrinsics, visible, sigma_px, np.zeros((3 * len(points), 0)))
        if not np.isfinite(equations.limited):
            return np.inf
        rows, solved = (part.reshape(len(equations.own), 6, -1) for part in (equations.whitened, equations.solved))
        try:
            factor = np.linalg.cholesky(equations.own - _products(rows))
        except np.linalg.LinAlgError:
            return np.inf
        back = np.linalg.inv(factor)
        if not (back * back).sum(axis=1).max() < LOOSE:
            return np.inf
        return float(equations.limited + ((back @ _products(solved)) * back).sum())


def propagated(
    world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats, basis: Floats
) -> Floats:
    """Return (1 + d,) the trace (m²) and the variances of d linear functions of the points; inf when not determined.

    Args:
        basis: (3m, 7 + d): the datum's basis, then the functions g, projected to it: orthogonal to the basis.
        Others: as of :func:`total_trace`.
    """
    undetermined = np.full(basis.shape[1] - 6, np.inf)
    with one_blas_thread():
        equations = _Reduced.of(world_from_cam, points, intrinsics, visible, sigma_px, basis)
        if not np.isfinite(equations.limited):
            return undetermined
        width = len(equations.solved)
        product = equations.whitened @ equations.whitened.T
        turned, functions = product[:width, width : width + 7], product[:width, width + 7 :]
        spread = equations.solved @ equations.solved.T
        spread -= turned @ turned.T
        schur = equations.bordered
        schur -= product[:width, :width]
        factor, failed = lapack.dpotrf(schur.T, lower=1, overwrite_a=1)  # symmetric: its transpose is in Fortran order
        if failed:
            return undetermined
        of_points = np.diagonal(product)[width:]
        variances = of_points[7:].copy()
        if len(variances):
            variances += (lapack.dtrtrs(factor, functions, lower=1)[0] ** 2).sum(axis=0)
        inverse = lapack.dpotri(factor, lower=1, overwrite_c=1)[0]  # zero above the diagonal
        if not np.diagonal(inverse).max() < LOOSE:
            return undetermined
        of_cameras = 2.0 * np.vdot(inverse.T, spread) - np.diagonal(inverse) @ np.diagonal(spread)
    result = np.append(equations.limited - of_points[:7].sum() + of_cameras, variances)
    return np.where(result > 0, result, np.inf)


def _products(rows: Floats) -> Floats:
    """Return A Aᵀ (n, 6, 6) of the images' own rows A (n, 6, 3m)."""
    return np.asarray(np.vecdot(rows[:, :, None, :], rows[:, None, :, :]))


@dataclass(frozen=True, kw_only=True)
class _Reduced:
    """What the elimination of the points leaves, camera-side unknowns scaled to a unit diagonal of N_cc.

    Attributes:
        limited: tr D, inf when an image or a point is loose.
        whitened: (6n + c, 3m) R and (L⁻¹ basis)ᵀ.  solved: (6n, 3m) Bᵀ.  own: (n, 6, 6) blocks of N_cc.
        bordered: (6n, 6n) N_cc and the datum's border, (0, 0) when not asked for.
    """

    limited: float
    whitened: Floats
    solved: Floats
    own: Floats
    bordered: Floats

    @classmethod
    def of(
        cls, world_from_cam: Floats, points: Floats, intrinsics: Floats, visible: Bools, sigma_px: Floats, basis: Floats
    ) -> Self:
        """Eliminate the points; a basis without columns: without the border."""
        images, count = visible.shape
        width, columns = 6 * images, basis.shape[1]
        # One block: allocated by itself, each of the two would be given back to the system at every call.
        work = np.empty((2 * width + columns, 3, count))
        solved, whitened = work[:width], work[width:]
        own, bordered = np.empty((images, 6, 6)), np.empty((width, width) if columns else (0, 0))
        limited = eliminate_points(
            np.ascontiguousarray(world_from_cam), np.ascontiguousarray(points), intrinsics,
            np.ascontiguousarray(visible), sigma_px, np.ascontiguousarray(basis), whitened, solved, own, bordered,
        )  # fmt: skip
        return cls(
            limited=limited, whitened=whitened.reshape(-1, 3 * count), solved=solved.reshape(-1, 3 * count),
            own=own, bordered=bordered,
        )  # fmt: skip
