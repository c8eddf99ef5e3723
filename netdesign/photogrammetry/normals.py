"""Normal equations of a bundle, reduced to the camera side (Schur complement).

Unknowns fall into points (3 per point, eliminated) and everything else, the W "camera-side" unknowns: poses,
interior orientation and the few points that scale bars tie to each other. With whitened derivatives A_p, A_c of the
image points and residuals l = observed - computed:

    N_pp = blkdiag_i (Σ A_pᵀ A_p + prior),   N_pc = Σ A_pᵀ A_c,   N_cc = Σ A_cᵀ A_c
    D = N_pp⁻¹  (the limited covariance),    B = D N_pc  (3m, W)
    S = N_cc - N_pcᵀ B                       the reduced normal matrix
    Σ_cc = S⁻,   Σ_pp = D + B S⁻ Bᵀ,   Σ_pc = -B S⁻        for any g-inverse S⁻, that is in any datum
    dc = S⁻ (l_c - Bᵀ l_p),   dp = D l_p - B dc

Sources: D. C. Brown, The Bundle Adjustment, ISP 1976; B. Triggs et al., Bundle Adjustment, 1999, section 6.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.compiled import entry
from netdesign.photogrammetry.coupling import Coupling


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """The observation equations at one approximation, whitened by the observations' covariance.

    Attributes:
        columns: (k, q) camera-side unknowns that each image point depends on, -1 where fewer than q.
        camera: (k, 2, q) derivatives with respect to them.  point_part: (k, 2, 3) with respect to the point.
        point: (k,) point index.  residual: (k, 2) observed - computed.
        width: W, number of camera-side unknowns.  eliminated: (m,) points that are unknown and not camera-side.
        point_prior: (m, 3, 3), point_prior_rhs: (m, 3): normal equations of directly measured coordinates.
        camera_prior: (W, W), camera_prior_rhs: (W,): normal equations of everything measured on the camera side.
    """

    columns: Ints
    camera: Floats
    point_part: Floats
    point: Ints
    residual: Floats
    width: int
    eliminated: Bools
    point_prior: Floats
    point_prior_rhs: Floats
    camera_prior: Floats
    camera_prior_rhs: Floats


@dataclass(frozen=True, kw_only=True)
class Reduced:
    """The reduced normal equations.

    Attributes:
        inverse: D (m, 3, 3), zero for points that are not eliminated.  coupling: B (3m, W), zero for the same points.
        schur: S (W, W).  diagonal: (W,) of N_cc, the natural scale of the camera side.
        point_rhs: (m, 3).  camera_rhs: (W,) already reduced.
        point_condition: (m,) smallest over largest eigenvalue of N_pp, 1 for points that are not eliminated.
    """

    inverse: Floats
    coupling: Coupling
    schur: Floats
    diagonal: Floats
    point_rhs: Floats
    camera_rhs: Floats
    point_condition: Floats


def reduce_normals(linearised: Linearised, damping: float = 0.0) -> Reduced:
    """Return the reduced normal equations; ``damping`` multiplies the diagonals by 1 + damping (Levenberg-Marquardt).

    A point whose N_pp is singular gets the pseudo-inverse; ``point_condition`` tells.
    """
    order = np.argsort(linearised.point, kind="stable")
    count = len(linearised.eliminated)
    start = np.searchsorted(linearised.point[order], np.arange(count + 1))
    point_part = np.where(linearised.eliminated[linearised.point][:, None, None], linearised.point_part, 0.0)
    npp = linearised.point_prior.copy()
    rhs = linearised.point_prior_rhs.copy()
    _add_points(linearised.point, point_part, linearised.residual, npp, rhs)
    npp[:, range(3), range(3)] *= 1.0 + damping
    inverse, condition = _inverse3(npp, linearised.eliminated)
    schur, entries, column, value, camera_rhs, diagonal = _eliminate(
        start.astype(np.int64),
        linearised.eliminated,
        linearised.columns[order],
        linearised.camera[order],
        point_part[order],
        linearised.residual[order],
        inverse,
        rhs,
        linearised.width,
    )
    diagonal = diagonal + np.diag(linearised.camera_prior)
    schur = schur + linearised.camera_prior
    schur[range(linearised.width), range(linearised.width)] += damping * diagonal
    return Reduced(
        inverse=inverse,
        coupling=Coupling(start=entries, column=column, value=value, width=linearised.width),
        schur=schur,
        diagonal=diagonal,
        point_rhs=rhs,
        camera_rhs=camera_rhs + linearised.camera_prior_rhs,
        point_condition=condition,
    )


def _inverse3(npp: Floats, eliminated: Bools) -> tuple[Floats, Floats]:
    """Return the inverses (m, 3, 3) of the point blocks and their eigenvalue ratios (m,)."""
    values, vectors = np.linalg.eigh(np.where(eliminated[:, None, None], npp, np.eye(3)))
    largest = np.maximum(values[:, -1], 1e-300)
    condition = np.maximum(values[:, 0], 0.0) / largest
    safe = np.where(values > 1e-14 * largest[:, None], values, np.inf)
    inverse = np.einsum("mij,mj,mkj->mik", vectors, 1.0 / safe, vectors)
    # Well-conditioned blocks: one Newton step removes the eigen-decomposition's last digits.
    healthy = condition > 1e-8
    inverse[healthy] = inverse[healthy] @ (2.0 * np.eye(3) - npp[healthy] @ inverse[healthy])
    inverse = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
    inverse[~eliminated] = 0.0
    condition[~eliminated] = 1.0
    return inverse, condition


@entry()
def _add_points(
    point: Ints, point_part: Floats, residual: Floats, npp: Floats, rhs: Floats
) -> None:  # pragma: no cover - compiled
    """Add the image points' normal equations to those of the points."""
    for k in range(point.shape[0]):
        p = point[k]
        for i in range(3):
            for row in range(2):
                rhs[p, i] += point_part[k, row, i] * residual[k, row]
                for j in range(3):
                    npp[p, i, j] += point_part[k, row, i] * point_part[k, row, j]


@entry()
def _eliminate(
    start: Ints,
    eliminated: Bools,
    columns: Ints,
    camera: Floats,
    point_part: Floats,
    residual: Floats,
    inverse: Floats,
    point_rhs: Floats,
    width: int,
) -> tuple[Floats, Ints, Ints, Floats, Floats, Floats]:  # pragma: no cover - compiled
    """Return S, B (start, column, value), the reduced right-hand side, diag N_cc; image points are sorted by point."""
    count = start.shape[0] - 1
    slots = columns.shape[1]
    schur = np.zeros((width, width))
    entries = np.zeros(count + 1, dtype=np.int64)
    column = np.empty(columns.shape[0] * slots, dtype=np.int64)
    value = np.empty((columns.shape[0] * slots, 3))
    rhs = np.zeros(width)
    diagonal = np.zeros(width)
    cross = np.zeros((width, 3))  # N_pc of the point in hand, transposed
    place = np.full(width, -1, dtype=np.int64)
    filled = 0
    for point in range(count):
        first = filled
        for k in range(start[point], start[point + 1]):
            for a in range(slots):
                ca = columns[k, a]
                if ca < 0:
                    continue
                if eliminated[point] and place[ca] < 0:
                    place[ca] = filled
                    column[filled] = ca
                    filled += 1
                rhs[ca] += camera[k, 0, a] * residual[k, 0] + camera[k, 1, a] * residual[k, 1]
                for axis in range(3):
                    cross[ca, axis] += (
                        camera[k, 0, a] * point_part[k, 0, axis] + camera[k, 1, a] * point_part[k, 1, axis]
                    )
                for b in range(slots):
                    cb = columns[k, b]
                    if cb >= 0:
                        schur[ca, cb] += camera[k, 0, a] * camera[k, 0, b] + camera[k, 1, a] * camera[k, 1, b]
                diagonal[ca] += camera[k, 0, a] ** 2 + camera[k, 1, a] ** 2
        for index in range(first, filled):
            ca = column[index]
            for axis in range(3):
                product = 0.0
                for other in range(3):
                    product += inverse[point, axis, other] * cross[ca, other]
                value[index, axis] = product
                rhs[ca] -= product * point_rhs[point, axis]
        for index in range(first, filled):
            ca = column[index]
            for other in range(first, filled):
                schur[ca, column[other]] -= (
                    cross[ca, 0] * value[other, 0] + cross[ca, 1] * value[other, 1] + cross[ca, 2] * value[other, 2]
                )
        for index in range(first, filled):
            place[column[index]] = -1
            for axis in range(3):
                cross[column[index], axis] = 0.0
        entries[point + 1] = filled
    return 0.5 * (schur + schur.T), entries, column[:filled].copy(), value[:filled].copy(), rhs, diagonal


@dataclass(frozen=True, kw_only=True)
class CameraSide:
    """The inverse of the reduced normal matrix with its diagnosis.

    Attributes:
        inverse: a g-inverse S⁻ (W, W), or the inverse when nothing is open.
        eigenvalues: ascending, of S with unit N_cc diagonal (Jacobi scaling), the datum's zeros raised to 1.
        null_vectors: (W, d') directions that the measurements do not determine besides the datum, scaled to unit
            length in units of each unknown's own standard deviation; d' = 0 for a healthy network.
        defect: number of datum parameters that are open by design.
    """

    inverse: Floats
    eigenvalues: Floats
    null_vectors: Floats
    defect: int

    @property
    def determined(self) -> bool:
        """Nothing but the datum is open."""
        return len(self.null_vectors.T) == 0

    @property
    def first_eigenvalue(self) -> float:
        """The smallest eigenvalue that the datum does not explain: lambda8 of a free network."""
        return float(self.eigenvalues[0]) if len(self.eigenvalues) > self.defect else float("inf")


RANK_TOLERANCE = 1e-12


def invert_camera_side(reduced: Reduced, null_space: Floats, constraints: Floats | None = None) -> CameraSide:
    """Return a g-inverse of S and what the network leaves undetermined.

    Args:
        null_space: (W, d) camera-side rows G_c of what the datum leaves open.
        constraints: (b, W) rows H of error-free relations H dc = 0 on the camera side, or None. Solved in their null
            space, S⁻ = Z (Zᵀ S Z)⁻ Zᵀ.

    The datum is removed by adding G̃ G̃ᵀ (G̃ orthonormal) to the scaled S, which leaves every estimable quantity as it
    is. Undetermined directions are inverted as zero, so the result is finite; whoever uses it looks at
    ``null_vectors`` first.
    """
    scale = 1.0 / np.sqrt(np.where(reduced.diagonal > 0, reduced.diagonal, 1.0))
    scaled = reduced.schur * scale[:, None] * scale[None, :]
    gauge = null_space / scale[:, None]
    if constraints is not None and len(constraints):
        _, _, right = np.linalg.svd(constraints * scale[None, :])
        free = right[len(constraints) :].T
    else:
        free = np.eye(len(scale))
    scaled = free.T @ scaled @ free
    basis = np.linalg.qr(free.T @ gauge)[0] if gauge.shape[1] else np.zeros((free.shape[1], 0))
    scaled = 0.5 * (scaled + scaled.T)
    eigenvalues, vectors = np.linalg.eigh(scaled + basis @ basis.T)
    open_ = eigenvalues < RANK_TOLERANCE * max(float(eigenvalues[-1]), 1.0)
    weights = np.where(open_, 0.0, 1.0 / np.where(open_, 1.0, eigenvalues))
    inverse = (vectors * weights) @ vectors.T
    if not open_.any():
        # One Newton step: the eigen-decomposition loses digits that the inverse can keep.
        matrix = scaled + basis @ basis.T
        inverse = inverse @ (2.0 * np.eye(len(matrix)) - matrix @ inverse)
    inverse = free @ inverse @ free.T
    inverse = 0.5 * (inverse + inverse.T) * scale[:, None] * scale[None, :]
    return CameraSide(
        inverse=inverse, eigenvalues=eigenvalues, null_vectors=free @ vectors[:, open_], defect=null_space.shape[1]
    )
