"""The datum: what a free network cannot know, inner constraints and the S-transformation.

Image measurements alone leave three translations, three rotations and the scale open. The null space of the normal
equations, one row block per unknown and one column per open parameter (translation, rotation, scale about `centre`):

    point  X:       [ I,  -[X]ₓ,  X ]
    camera (R, t):  [ 0,  Rᵀ,  0 ;  Rᵀ,  -Rᵀ[t]ₓ,  Rᵀt ]        rows omega, v of the pose tangent
    scale bar known, or any length measured: the scale column is not in the null space (parameters = 6)

S-transformation (W. Baarda, S-transformations and criterion matrices, 1973) of a covariance to the datum in which the
points selected by E satisfy Gᵀ E dx = 0:   Σ_E = S Σ Sᵀ,  S = I - G (Gᵀ E G)⁻¹ Gᵀ E.
With E = I this is the inner-constraint solution, the one of smallest trace over the points (P. Meissl, 1969).
"""

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import skew


def point_null_space(points: Floats, centre: Floats | None = None, parameters: int = 7) -> Floats:
    """Return (3m, parameters): the null space's rows of points (m, 3), about ``centre`` (3,) or their centroid."""
    centred = points - (points.mean(axis=0) if centre is None else centre)
    blocks = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(centred), centred[:, :, None]], axis=2
    )
    return np.ascontiguousarray(blocks.reshape(-1, 7)[:, :parameters])


def pose_null_space(world_from_cam: Floats, centre: Floats, parameters: int = 7) -> Floats:
    """Return (6n, parameters): the null space's rows of camera poses (n, 4, 4), tangent order omega, v."""
    transposed = np.swapaxes(world_from_cam[:, :3, :3], 1, 2)
    position = world_from_cam[:, :3, 3] - centre
    rows = np.zeros((len(world_from_cam), 6, 7))
    rows[:, :3, 3:6] = transposed
    rows[:, 3:, :3] = transposed
    rows[:, 3:, 3:6] = -transposed @ skew(position)
    rows[:, 3:, 6] = np.einsum("nij,nj->ni", transposed, position)
    return np.ascontiguousarray(rows.reshape(-1, 7)[:, :parameters])


def inner_basis(points: Floats, parameters: int = 7) -> Floats:
    """Return an orthonormal basis (3m, parameters) of the datum defect of points (m, 3).

    I - basis basisᵀ projects any covariance of the points to the inner-constraint datum over all of them.

    Raises:
        ValueError: fewer than three points, or all on one line: they define no datum.
    """
    centred = points - points.mean(axis=0)
    extent = float(np.sqrt((centred**2).sum(axis=1).mean())) or 1.0
    # In units of the extent the columns are comparable; their span does not depend on the unit.
    basis, triangle = np.linalg.qr(point_null_space(centred / extent, parameters=parameters))
    size = np.abs(np.diag(triangle))
    if len(points) < 3 or size.min() <= 1e-9 * size.max():
        raise ValueError(f"points: expected at least 3 that are not on one line, found {len(points)}")
    return np.asarray(basis)


def datum_operator(points: Floats, datum_points: Bools | None = None, null_space: Floats | None = None) -> Floats:
    """Return A (d, 3m) = (Gᵀ E G)⁻¹ Gᵀ E, so that x_E = x - G (A x_points) for every unknown with rows G.

    Args:
        points: (m, 3).  datum_points: (m,) the points that carry the datum, None for all.
        null_space: (3m, d) the points' rows G of what is open, default all seven parameters.

    Raises:
        ValueError: the datum points do not fix what is open (fewer than three, or on one line).
    """
    g = point_null_space(points) if null_space is None else null_space
    selector = np.ones(len(g)) if datum_points is None else np.repeat(datum_points.astype(np.float64), 3)
    if g.shape[1] == 0:
        return np.zeros((0, len(g)))
    weighted = g * selector[:, None]
    # Columns of G have different units: scale them before judging and inverting.
    scale = 1.0 / np.sqrt((g * g).sum(axis=0) + 1e-300)
    normal = (g * scale).T @ (weighted * scale)
    values = np.linalg.eigvalsh(normal)
    if values[0] <= 1e-12 * values[-1]:
        raise ValueError(f"datum points: {int(selector.sum()) // 3} points do not fix {g.shape[1]} datum parameters")
    return np.asarray(scale[:, None] * np.linalg.solve(normal, (weighted * scale).T))


def s_transformation(
    covariance: Floats, points: Floats, datum_points: Bools | None = None, parameters: int = 7
) -> Floats:
    """Return the covariance (3m, 3m) of points (m, 3) carried to the datum of ``datum_points`` (all when None).

    Args:
        covariance: (3m, 3m) in any datum.
        parameters: 7 for a free network; 6 when the scale is known and must not be transformed away.

    Raises:
        ValueError: the datum points do not fix the datum.
    """
    g = point_null_space(points, parameters=parameters)
    operator = datum_operator(points, datum_points, g)
    half = covariance - g @ (operator @ covariance)
    transformed = half - (half @ operator.T) @ g.T
    return 0.5 * (transformed + transformed.T)


def blocks(covariance: Floats) -> Floats:
    """Return the diagonal blocks (m, 3, 3) of a joint covariance (3m, 3m)."""
    count = len(covariance) // 3
    index = np.arange(count)
    return np.ascontiguousarray(covariance.reshape(count, 3, count, 3)[index, :, index, :])
