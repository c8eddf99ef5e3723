"""Total error propagation: the covariance of the object points from the full bundle, before any image exists.

Limited error propagation holds the poses error-free; here they are unknowns like the points. Datum: inner constraints
over all object points (the free network of smallest trace), unless said otherwise. With D, B, S of ``normals`` and Q an
orthonormal basis of the points' datum defect:

    Σ = P (D + B S⁻ Bᵀ) P,  P = I - Q Qᵀ,     trace Σ = tr D - tr QᵀDQ + tr S⁻ (BᵀB - UUᵀ),  U = BᵀQ

The total variance may be a little smaller than the limited one in strong networks: the datum takes 7 of the 3m
dimensions out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.network import Observations
from netdesign.model.results import PointPrecision
from netdesign.photogrammetry.connectivity import (
    listed,
    named,
    numeric_complaints,
    structure_complaints,
    tie_flags,
    weakest_part,
)
from netdesign.photogrammetry.datum import inner_basis, pose_null_space
from netdesign.photogrammetry.normals import CameraSide, Reduced, invert_camera_side, reduce_normals
from netdesign.photogrammetry.observation_equations import Layout, linearise, parameter_matrix, whitener

DATUM = "free: inner constraints over all object points"
FLAG_RATIO = 1.5  # total / limited variance above which a network is flagged
POINT_CONDITION = 1e-9  # smallest / largest eigenvalue of a point's normals below which its rays are parallel


@dataclass(frozen=True, kw_only=True)
class TotalError:
    """The predicted covariance of the object points and what is wrong with the network, if anything.

    Attributes:
        covariance: (m, 3, 3) m², inf everywhere when the network is not determined.
        limited: (m, 3, 3) m², poses error-free; inf for points with parallel rays or fewer than two.
        rays: (m,) images per point.  determined: nothing but the datum is open.
        lambda8: smallest eigenvalue of the scaled reduced normals that the datum does not explain.
        diagnosis: in words: what is not determined and why; or, of a determined network, what is weak about it.
    """

    covariance: Floats
    limited: Floats
    rays: Ints
    determined: bool
    lambda8: float
    diagnosis: tuple[str, ...]
    reduced: Reduced
    camera_side: CameraSide
    basis: Floats

    @property
    def trace(self) -> float:
        """Trace of the joint covariance, m²."""
        return float(np.trace(self.covariance, axis1=1, axis2=2).sum())

    @property
    def limited_trace(self) -> float:
        """Trace of the limited covariance, m²."""
        return float(np.trace(self.limited, axis1=1, axis2=2).sum())

    @property
    def ratio(self) -> float:
        """Total over limited variance; 1 when neither is finite would mean nothing, so inf then."""
        return self.trace / self.limited_trace if np.isfinite(self.limited_trace) else float("inf")

    @property
    def precision(self) -> PointPrecision:
        """The covariance as a design reports it."""
        return PointPrecision(covariance=self.covariance, rays=self.rays, propagation="total", datum=DATUM)

    def joint(self) -> Floats:
        """Return the full covariance (3m, 3m) m², inner constraints over all points.

        Raises:
            ValueError: the network is not determined.
        """
        if not self.determined:
            raise ValueError("the network is not determined: " + "; ".join(self.diagnosis))
        return joint_covariance(self.reduced, self.camera_side.inverse, self.basis)


def joint_covariance(reduced: Reduced, camera_inverse: Floats, basis: Floats) -> Floats:
    """Return P (D + B S⁻ Bᵀ) P (3m, 3m), P = I - basis basisᵀ."""
    coupling = reduced.coupling.dense()
    covariance = coupling @ camera_inverse @ coupling.T
    count = len(reduced.inverse)
    index = np.arange(count)
    covariance.reshape(count, 3, count, 3)[index, :, index, :] += reduced.inverse
    half = covariance - basis @ (basis.T @ covariance)
    result = half - (half @ basis) @ basis.T
    return np.asarray(0.5 * (result + result.T))


def block_covariance(reduced: Reduced, camera_inverse: Floats, basis: Floats) -> Floats:
    """Return the diagonal blocks (m, 3, 3) of ``joint_covariance`` without forming it."""
    count = len(reduced.inverse)
    q = basis.reshape(count, 3, -1)
    # P B S⁻ Bᵀ P: project B first; P D P block by block: D - q qᵀD - D q qᵀ + q (QᵀDQ) qᵀ.
    projected = (reduced.coupling.dense() - basis @ reduced.coupling.under(basis.T)).reshape(count, 3, -1)
    spread = (projected.reshape(3 * count, -1) @ camera_inverse).reshape(count, 3, -1)
    result = np.einsum("mia,mja->mij", spread, projected)
    dq = reduced.inverse @ q
    inner = np.einsum("mia,mib->ab", q, dq)
    cross = np.einsum("mia,mja->mij", dq, q)
    result += reduced.inverse - cross - np.swapaxes(cross, 1, 2) + np.einsum("mia,ab,mjb->mij", q, inner, q)
    return np.asarray(0.5 * (result + np.swapaxes(result, 1, 2)))


def total_covariance(
    world_from_cam: Floats,
    points: Floats,
    intrinsics: Floats,
    visible: Bools,
    sigma_px: float | Floats,
    refine: tuple[str, ...] = (),
    image_names: Sequence[str] | None = None,
    point_names: Sequence[str] | None = None,
) -> TotalError:
    """Propagate image noise through the full bundle adjustment.

    Args:
        world_from_cam: (n, 4, 4) m.  points: (m, 3) m.  intrinsics: (8,).
        visible: (n, m) which image sees which point.
        sigma_px: one image-coordinate sigma, or (n, m).
        refine: interior parameters that are unknowns too, of f, fx, fy, cx, cy, k1, k2, p1, p2 (self-calibration).
        image_names, point_names: for the diagnosis; default: the indices.
    """
    image_names = [str(i) for i in range(visible.shape[0])] if image_names is None else image_names
    point_names = [str(j) for j in range(visible.shape[1])] if point_names is None else point_names
    image, point = np.nonzero(visible)
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), visible.shape)[image, point]
    observations = Observations(
        image=image,
        point=point,
        xy_px=np.zeros((len(image), 2)),
        covariance=sigma[:, None, None] ** 2 * np.eye(2),
    )
    rays = visible.sum(axis=0).astype(np.int64)
    layout = Layout(
        images=len(world_from_cam),
        camera_of_image=np.zeros(len(world_from_cam), dtype=np.int64),
        parameters=(parameter_matrix(refine, intrinsics),),
        kept=np.zeros(len(points), dtype=np.bool_),
        eliminated=np.ones(len(points), dtype=np.bool_),
    )
    centre = points.mean(axis=0)
    linearised, depth = linearise(
        observations, layout, world_from_cam, points, intrinsics[None, :], whitener(observations.covariance)
    )
    reduced = reduce_normals(linearised)
    null_space = np.vstack([pose_null_space(world_from_cam, centre), np.zeros((len(refine), 7))])
    camera_side = invert_camera_side(reduced, null_space)
    basis = inner_basis(points)
    parallel = reduced.point_condition < POINT_CONDITION
    limited = reduced.inverse.copy()
    limited[parallel] = np.inf
    complaints = structure_complaints(visible, image_names, point_names)
    if parallel.any() and not complaints:
        names = named(point_names, parallel)
        complaints += (f"{len(names)} point(s) are seen from one position only (parallel rays): {listed(names)}",)
    behind = np.flatnonzero(~(depth > 0))
    if len(behind):
        pairs = zip(named(point_names, point[behind]), named(image_names, image[behind]), strict=True)
        where = [f"{name} in image {image_name}" for name, image_name in pairs]
        complaints += (f"{len(behind)} point(s) lie behind the camera that sees them: {listed(where)}",)
    if not complaints:
        complaints = numeric_complaints(camera_side, len(world_from_cam), image_names, refine)
    covariance = np.full((len(points), 3, 3), np.inf)
    if not complaints:
        covariance = block_covariance(reduced, camera_side.inverse, basis)
    result = TotalError(
        covariance=covariance,
        limited=limited,
        rays=rays,
        determined=not complaints,
        lambda8=camera_side.first_eigenvalue,
        diagnosis=complaints,
        reduced=reduced,
        camera_side=camera_side,
        basis=basis,
    )
    if complaints:
        return result
    return replace(result, diagnosis=_flags(result, visible, image_names, point_names))


def _flags(
    total: TotalError, visible: Bools, image_names: Sequence[str], point_names: Sequence[str]
) -> tuple[str, ...]:
    """Return what is weak about a determined network, with the images and points that cause it."""
    flags = tie_flags(visible, image_names)
    if total.ratio <= FLAG_RATIO:
        return flags
    count, images = len(total.rays), visible.shape[0]
    spread = np.trace(total.covariance, axis1=1, axis2=2) - np.trace(total.limited, axis1=1, axis2=2)
    projected = total.reduced.coupling.dense() - total.basis @ total.reduced.coupling.under(total.basis.T)
    # S⁻ in the inner-constraint datum is not needed: P B makes the product independent of the datum. What image i
    # causes is the part of trace(P B S⁻ Bᵀ P) in its six columns.
    caused = np.einsum("pw,pw->w", projected @ total.camera_side.inverse, projected)[: 6 * images]
    by_image = np.maximum(caused.reshape(images, 6).sum(axis=1), 0.0)
    where, which = weakest_part(spread, by_image, image_names, point_names)
    text = (
        f"total / limited variance {total.ratio:.2f} exceeds {FLAG_RATIO}: most of it enters through images {where} "
        f"and shows at points {which} of {count}"
    )
    return (text, *flags)
