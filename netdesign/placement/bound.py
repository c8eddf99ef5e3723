"""A proven lower bound on f1 for every number of images: how far from the best possible is a network?

f1 = Σ_j tr(N_j⁻¹) / 3m with N_j = Σ_i M_j(v_i) over the k images. For every symmetric Z_j

    tr(N_j⁻¹) >= 2 tr Z_j - tr(Z_j N_j Z_j)          (because tr((N^-½ - N^½ Z)ᵀ (N^-½ - N^½ Z)) >= 0)

Added over the points, with H an upper bound of h(v) = Σ_j tr(Z_j M_j(v) Z_j) over everything a viewpoint of the study
can give, T = Σ_j tr Z_j, and the best common scale of the Z_j,

    f1 >= T² / (3 m k H)      for every network of k admissible images.

Good Z_j come from the continuous relaxation (``optimal_design``), Z_j = N_j⁻¹ at its solution; there it is sharp.
They need not be optimal for the bound to hold. H is proved cell by cell over the whole sphere (``information``): a tag
counts as seen where the visibility map cannot exclude it, every cell by its best viewpoint. Cells that stand out become
candidates and the weights are solved again.

The closed form 1.5 sigma² / Σ S⁻² per point is the special case of isotropic Z_j with every point's own best
viewpoints; the relaxation, which has to share its viewpoints among the points, is never weaker.

Distortion counts by its largest gain at the radius where a point appears, unequal focal lengths by the larger one, a
sigma per sighting by its smallest value in the cell: exact without distortion and with constant sigma.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.photogrammetry.precision import corner_sigma
from netdesign.placement.information import largest_gains, normal_matrices, quadratic_forms
from netdesign.placement.optimal_design import inverses, optimal_weights
from netdesign.placement.visibility_cells import Words
from netdesign.placement.visibility_map import VisibilityMap, field_bounds, spread_angle

CANDIDATE_STEP = np.radians(4.0)
ROUNDS = 10
SHY = 20  # tags seen by fewer candidates get candidates of their own
# Stop when the bound is this close to the relaxation's own value.
TOLERANCE = 4e-3
# Taken off every bound: more than the rounding of the sums.
ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class _Views:
    """What the kernels need about a study; see ``information`` for the units."""

    map: VisibilityMap
    bits: Words
    radius: float
    points: Floats
    normals: Floats
    gains: Floats
    sigmas: Floats

    def matrices(self, cells: Ints) -> Floats:
        """(c, 6 m) normal matrices in the middle of the cells."""
        visible = np.repeat(self.map.possible_tags(cells), CORNERS_PER_TAG, axis=1)
        viewpoints = self.map.centres[cells]
        found = normal_matrices(viewpoints, visible, self.radius, self.points, self.normals, self.gains, self.sigmas)
        return found.reshape(len(cells), -1)

    def largest(self, cells: Ints, inverse: Floats, parts: int = 1) -> Floats:
        """(c,) upper bounds of h over the cells for Z = inverse (m, 3, 3)."""
        forms = quadratic_forms(inverse @ inverse, self.points, self.radius)
        half_alpha, half_beta = (half / parts for half in self.map.half_steps)
        beta = self.map.grid[3] + half_beta * (1 + 2 * np.arange(parts * self.map.rows))
        spreads = spread_angle(beta, np.array(half_alpha), np.array(half_beta)).reshape(-1, parts)
        found: Floats = largest_gains(
            cells, self.map.grid, parts, spreads, self.bits, self.radius, self.points, self.normals, forms, self.gains,
            self.sigmas,
        )  # fmt: skip
        return found


def lower_bounds(task: Task, sizes: Iterable[int], visibility_map: VisibilityMap) -> dict[int, float]:
    """Return for every number of images in ``sizes`` a lower bound on f1 in m² for all networks of the study.

    Holds for the criterion mean_variance with limited propagation. For the other criteria (total propagation in the
    inner datum can lie slightly below the limited one), and when some tag can be seen from nowhere or the part reaches
    the viewing sphere, nothing is proved: the result is empty.
    """
    objectives = task.study.objectives
    if objectives.precision != "mean_variance" or objectives.propagation != "limited":
        return {}
    best = information_limit(task, visibility_map)
    return {} if best is None else {int(k): best / k for k in sizes if k > 0}


def information_limit(task: Task, visibility_map: VisibilityMap) -> float | None:
    """Return b such that f1 >= b / k (m²) for k images, or None when nothing can be proved."""
    views = _views(task, visibility_map)
    seen = np.flatnonzero((views.bits != 0).any(axis=1))
    if not _every_tag(views.bits[seen], visibility_map.tag_count):
        return None
    if np.linalg.norm(views.points, axis=1).max() >= 0.98 * views.radius:
        return None
    candidates = _candidates(visibility_map, seen)
    flat, weights = views.matrices(candidates), np.full(len(candidates), 1.0 / len(candidates))
    row, column = np.divmod(seen, visibility_map.columns)
    sparse = seen[(row % 2 == 0) & (column % 2 == 0)]
    lookout, last, best = sparse, np.inf, 0.0
    for _ in range(ROUNDS):
        keep, weights = optimal_weights(flat, weights)
        flat, candidates = flat[keep], candidates[keep]
        inverse = inverses(flat, weights)
        trace = float(np.trace(inverse, axis1=1, axis2=2).sum())
        heights = views.largest(lookout, inverse)
        gap = float(heights.max(initial=trace)) / trace - 1.0
        settled = gap <= TOLERANCE or abs(gap - last) <= 0.5 * TOLERANCE
        if lookout is seen:
            # Only a look at every cell proves anything.
            top = _refined(views, seen, heights, inverse, trace)
            best = max(best, trace**2 / (3.0 * len(views.points) * top))
            if settled:
                break
        new = np.setdiff1d(_standing_out(visibility_map, lookout, heights, trace), candidates)
        last, lookout = gap, seen if settled else lookout
        if new.size:
            flat = np.concatenate([flat, views.matrices(new)])
            weights = np.concatenate([0.9 * weights, np.full(len(new), 0.1 / len(new))])
            candidates = np.concatenate([candidates, new])
    return best * (1.0 - ROUNDING) if best > 0.0 else None


def _views(task: Task, visibility_map: VisibilityMap) -> _Views:
    targets, camera, sphere = task.scene.targets, task.camera, task.sphere
    points = targets.points - sphere.centre
    return _Views(
        bits=visibility_map.sure | visibility_map.maybe,
        map=visibility_map,
        radius=float(sphere.radius),
        points=np.ascontiguousarray(points),
        normals=np.ascontiguousarray(targets.point_normals),
        gains=_gain_table(camera, float(field_bounds(camera, task.limits, True)[1])),
        sigmas=_sigma_table(camera, targets.size_m, sphere.radius, float(np.linalg.norm(points, axis=1).max())),
    )


def _gain_table(camera: Camera, outer: float) -> Floats:
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


def _sigma_table(camera: Camera, tag_size: float, radius: float, reach: float) -> Floats:
    """focal² / sigma², at most, over depth and cosine of the incidence; last row: lowest depth and step of the depth.

    Sigma falls with a larger image of the tag and with a smaller incidence, so each bin takes its best corner.
    """
    focal = float(camera.focal_px.max())
    if camera.corner_noise is None:
        return np.array([[focal**2 / camera.sigma_px**2], [0.0]])
    lowest, step = radius - reach, 2.0 * reach / 256
    depth = np.maximum(lowest + step * (np.arange(256) - 1), 1e-6)
    cosine = (np.arange(256) + 1) / 256.0
    edge = float(np.sqrt(camera.focal_px.prod())) * tag_size / depth
    sigma = corner_sigma(camera, edge[:, None], np.arccos(cosine)[None])
    last = np.zeros((1, 256))
    last[0, :2] = lowest, step
    return np.ascontiguousarray(np.concatenate([focal**2 / sigma**2, last]))


def _every_tag(bits: Words, tag_count: int) -> bool:
    """Tell whether every tag has its bit in some row."""
    seen = np.unpackbits(np.bitwise_or.reduce(bits, axis=0).view(np.uint8), bitorder="little")
    return bool(seen[:tag_count].all())


def _candidates(visibility_map: VisibilityMap, seen: Ints) -> Ints:
    """Cells about CANDIDATE_STEP apart in both directions, of those from which something is seen; more for shy tags."""
    half_alpha, half_beta = visibility_map.half_steps
    every = max(1, round(CANDIDATE_STEP / (2 * half_beta)))
    row, column = np.divmod(seen, visibility_map.columns)
    beta = visibility_map.centres[seen, 1]
    along = np.maximum(1, np.round(CANDIDATE_STEP / (2 * half_alpha * np.maximum(np.cos(beta), 1e-3)))).astype(int)
    chosen = seen[(row % every == every // 2) & (column % along == 0)]
    shy = np.flatnonzero(visibility_map.possible_tags(chosen).sum(axis=0) < SHY)
    for tag in shy.tolist():
        bit = np.uint64(1) << np.uint64(tag % 64)
        views = (visibility_map.sure | visibility_map.maybe)[seen, tag // 64] & bit
        cells = seen[views != 0]
        chosen = np.concatenate([chosen, cells[np.linspace(0, len(cells) - 1, min(SHY, len(cells))).astype(int)]])
    return np.unique(chosen)


def _refined(views: _Views, seen: Ints, heights: Floats, inverse: Floats, trace: float) -> float:
    """Largest h over the sphere: cells above the mean are cut into parts until cutting gains nothing."""
    order = np.argsort(heights)[::-1]
    above = order[heights[order] > trace][:4000]
    rest = float(heights[order[len(above)]]) if len(above) < len(order) else 0.0
    finer = views.largest(seen[above], inverse, parts=4) if above.size else np.zeros(0)
    return max(rest, float(np.minimum(finer, heights[above]).max(initial=0.0)))


def _standing_out(visibility_map: VisibilityMap, seen: Ints, heights: Floats, trace: float) -> Ints:
    """The highest cell of every block of 6 x 6 cells among those above the mean."""
    high = np.flatnonzero(heights > (1.0 + 0.5 * TOLERANCE) * trace)
    high = high[np.argsort(-heights[high], kind="stable")]
    row, column = np.divmod(seen[high], visibility_map.columns)
    block = (row // 6) * visibility_map.columns + column // 6
    _, first = np.unique(block, return_index=True)
    return seen[high[np.sort(first)[:400]]]
