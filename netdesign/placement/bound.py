"""A proven lower bound on f1 for every number of images: how far from the best possible is a network?

f1 = Σ_j tr(N_j⁻¹) / 3m with N_j = F_j + Σ_i M_j(v_i): F_j of the existing stations, M_j of the n others. For every
symmetric Z_j

    tr(N_j⁻¹) >= 2 tr Z_j - tr(Z_j N_j Z_j)          (because tr((N^-½ - N^½ Z)ᵀ (N^-½ - N^½ Z)) >= 0)

Added over the points, with H an upper bound of h(v) = Σ_j tr(Z_j M_j(v) Z_j) over everything an admissible station can
give, T = Σ_j tr Z_j, F = Σ_j tr(Z_j F_j Z_j) and the best common scale of the Z_j,

    f1 >= T² / (3 m (F + n H))      for every network of the existing and n admissible images.

Good Z_j come from the continuous relaxation (``optimal_design``), Z_j = N_j⁻¹ at its solution; there it is sharp.
They need not be optimal for the bound to hold. Without existing stations one choice serves all n; with them those of a
few n, of which every n takes its best. H is proved cell by cell over all directions and distances of the admissible
stations (``station_cells``, ``information``): a tag counts as seen where it cannot be excluded, every cell by its best
station. The cells that decide are cut, the middles of those that stand out become candidates, and the weights are
solved again.

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
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.photogrammetry.precision import corner_sigma
from netdesign.photogrammetry.visibility import Sight
from netdesign.placement.information import most_information, quadratic_forms
from netdesign.placement.optimal_design import information_of, inverses, optimal_weights
from netdesign.placement.station_cells import Cells, StationCells, reach
from netdesign.placement.visibility_map import field_bounds

CANDIDATE_STEP = np.radians(5.0)
FINER_STEP = np.radians(1.5)  # for tags that fewer than SHY candidates see
SHY = 20
ROUNDS = 8
BATCH = 4000  # cells that are cut at a time
BUDGET = 40_000  # cells looked at between two solutions of the weights
NEW = 300  # candidates of a round, at three distances each
# Stop when the bound is this close to the relaxation's own value, or two rounds raise it by less than a fifth of this.
TOLERANCE = 5e-3
# Taken off every bound: more than the rounding of the sums.
ROUNDING = 1e-9


def lower_bounds(task: Task, sizes: Iterable[int]) -> dict[int, float]:
    """Return for every number of images in ``sizes`` a lower bound on f1 in m² for all networks of the study.

    The existing stations count as images; sizes below their number have no networks and get no bound. Holds for the
    criterion mean_variance with limited propagation. For the other criteria (total propagation in the inner datum can
    lie slightly below the limited one), and when some tag is seen from nowhere, nothing is proved: the result is empty.
    """
    objectives = task.study.objectives
    if objectives.precision != "mean_variance" or objectives.propagation != "limited":
        return {}
    existing = len(task.existing)
    free = sorted({int(size) - existing for size in sizes if size >= max(existing, 1)})
    certificate = Certificate(task)
    # Without existing stations the best choice is the same for every size.
    proved = [certificate.proof(count) for count in (_some(free) if existing else free[:1])]
    found = {}
    for count in free:
        bound = max((proof.bound(count) for proof in proved if proof), default=0.0)
        if bound > 0.0:
            found[count + existing] = bound
    return found


@dataclass(frozen=True, kw_only=True)
class Proof:
    """T, F and H of one choice of the Z_j, and 3 m."""

    trace: float
    fixed: float
    largest: float
    coordinates: int

    def bound(self, count: int) -> float:
        """Return the lower bound on f1 in m² of ``count`` images beside the existing ones."""
        most = self.fixed + count * self.largest if count else self.fixed
        return self.trace**2 / (self.coordinates * most) * (1.0 - ROUNDING) if 0.0 < most < np.inf else 0.0


class Certificate:
    """Candidates for good Z_j and the cells of all admissible stations, which are cut further for every choice."""

    def __init__(self, task: Task) -> None:
        targets, camera, sphere = task.scene.targets, task.camera, task.sphere
        self.task, self.sight = task, Sight(task.scene, camera, task.limits)
        self.points = np.ascontiguousarray(targets.points - sphere.centre)
        self.normals = np.ascontiguousarray(targets.point_normals)
        self.gains = _gain_table(camera, float(field_bounds(camera, task.limits, True)[1]))
        near, far = reach(sphere)
        self.sigmas = _sigma_table(camera, targets.size_m, near, far, float(np.linalg.norm(self.points, axis=1).max()))
        seen = self.sight.look(task.existing).visible
        self.fixed = information_of(task, task.existing, seen).sum(axis=0)
        self.flat = self._sampled()
        self.space = StationCells(task)
        self.cells = self.space.first()

    def proof(self, count: int) -> Proof | None:
        """Return what a good choice of Z proves for ``count`` images beside the existing ones; None: nothing."""
        share = self.fixed / max(count, 1)
        if not (_traces(self.flat + share) > 0.0).any(axis=0).all():
            return None
        if not count:
            alone = (self.fixed[None], np.ones(1))
            return self._proof(*alone, np.inf) if (_traces(alone[0]) > 0.0).all() else None
        flat, weights = self.flat, np.full(len(self.flat), 1.0 / len(self.flat))
        self.cells = self.space.first()  # cut for this choice alone: what another one needs would only cost time
        best: Proof | None = None
        stalled = 0
        for _ in range(ROUNDS):
            keep, weights = optimal_weights(flat + share, weights)
            flat = flat[keep]
            inverse = inverses(flat + share, weights)
            form = _flattened(inverse @ inverse)
            mean = float(weights @ (flat @ form))
            heights = self._cut(inverse, mean)
            largest = float(heights.max(initial=0.0))
            found = self._proof(flat + share, weights, largest)
            before = best.bound(count) if best else 0.0
            best = found if found.bound(count) > before else best
            stalled = stalled + 1 if 0.0 < found.bound(count) <= (1.0 + 0.2 * TOLERANCE) * before else 0
            if largest <= (1.0 + TOLERANCE) * mean or stalled == 2:
                break
            new = self._standing_out(heights, mean)
            new = new[new @ form > mean]
            if len(new):
                flat = np.concatenate([flat, new])
                weights = np.concatenate([0.9 * weights, np.full(len(new), 0.1 / len(new))])
        return best

    def _proof(self, matrices: Floats, weights: Floats, largest: float) -> Proof:
        inverse = inverses(matrices, weights)
        trace = float(np.trace(inverse, axis1=1, axis2=2).sum())
        fixed = float(self.fixed @ _flattened(inverse @ inverse))
        return Proof(trace=trace, fixed=fixed, largest=largest, coordinates=3 * len(self.points))

    def _cut(self, inverse: Floats, mean: float) -> Floats:
        """Cut the cells that admit more than the mean until none is left or the budget is used; (c,) bounds of h."""
        forms = quadratic_forms(inverse @ inverse, self.points)
        found, looked = self._largest(self.cells, forms), 0
        while looked < BUDGET:
            above = np.flatnonzero(found[:, 0] > (1.0 + TOLERANCE) * mean)
            if not len(above):
                break
            if len(above) > BATCH:
                above = np.sort(above[np.argsort(-found[above, 0], kind="stable")[:BATCH]])
            rest = np.ones(len(self.cells), np.bool_)
            rest[above] = False
            parts = self.space.parts(self.cells.take(above), _axes(self.cells.take(above), found[above]))
            self.cells = self.cells.take(rest).joined(parts)
            found = np.concatenate([found[rest], self._largest(parts, forms)])
            looked += 2 * len(above)
        return np.asarray(found[:, 0])

    def _largest(self, cells: Cells, forms: Floats) -> Floats:
        """(c, 3) of ``most_information``."""
        found: Floats = most_information(
            cells.directions, cells.depths, cells.deltas, cells.possible, self.points, self.normals, forms, self.gains,
            self.sigmas,
        )  # fmt: skip
        return found

    def _standing_out(self, heights: Floats, mean: float) -> Floats:
        """(c, 6 m) of the nearest, middle and farthest stations of the highest cells, thinned, above the mean."""
        high = np.flatnonzero(heights > (1.0 + 0.5 * TOLERANCE) * mean)
        high = high[np.argsort(-heights[high], kind="stable")]
        cells = self.cells.take(high)
        place = np.column_stack([cells.directions / np.radians(3.0), np.log(cells.middle[:, 2:] + 1e-9) / 0.05])
        _, first = np.unique(np.round(place), axis=0, return_index=True)
        cells = cells.take(np.sort(first)[:NEW])
        near, far = cells.depths.T
        there = np.ones(len(cells), np.bool_)
        if self.task.sphere.depth is not None:
            least, largest = self.task.sphere.depth.limits(cells.directions)
            there = least <= largest
            near, far = (np.minimum(np.maximum(distance, least), largest) for distance in (near, far))
        offsets = [cells.directions[there] * distance[there, None] for distance in (near, 0.5 * (near + far), far)]
        return self._matrices(np.concatenate(offsets if self.task.sphere.depth else offsets[:1]))

    def _sampled(self) -> Floats:
        """(c, 6 m) of stations all over the admissible set, more of them for tags that few of these see."""
        sphere = self.task.sphere
        surface = sphere.depth is not None and not sphere.depth.has_width  # ``sample`` doubles the step of a depth
        offsets = [
            sphere_directions(viewpoints) * sphere.radii(viewpoints)[:, None]
            for viewpoints in (
                sphere.sample(0.5 * step if surface else step)[0] for step in (CANDIDATE_STEP, FINER_STEP)
            )
        ]
        flat = self._matrices(offsets[0])
        shy = ((_traces(flat) > 0.0).sum(axis=0) < SHY) & ~(_traces(self.fixed[None])[0] > 0.0)
        if shy.any():
            tags = shy[::CORNERS_PER_TAG]
            offsets[1] = offsets[1][np.linalg.norm(offsets[1], axis=1) > 0.0]
            poses = look_at(sphere.centre + offsets[1], sphere.centre, sphere.roll or 0.0)
            sees = np.flatnonzero(self.sight.look(poses).visible_tags[:, tags].any(axis=1))
            rows = np.linspace(0, len(sees) - 1, min(len(sees), SHY * int(tags.sum()))).astype(int)
            flat = np.concatenate([flat, self._matrices(offsets[1][sees[rows]])])
        return flat

    def _matrices(self, offsets: Floats) -> Floats:
        """(c, 6 m) normal matrices of stations at ``offsets`` (c, 3) from the centre; a free roll sees the most."""
        centre, roll = self.task.sphere.centre, self.task.sphere.roll
        offsets = offsets[np.linalg.norm(offsets, axis=1) > 0.0]  # a box may hold the centre itself
        rolls = np.arange(6) * np.pi / 6 if roll is None else np.array([roll])
        poses = [look_at(centre + offsets, centre, angle) for angle in rolls]
        visible = np.any([self.sight.look(turned).visible for turned in poses], axis=0)
        return information_of(self.task, poses[0], visible)


def _flattened(squares: Floats) -> Floats:
    """(6 m,) such that its product with a row of normal matrices is Σ tr(Y_j M_j), from Y (m, 3, 3)."""
    return np.asarray((squares[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] * [1.0, 2, 2, 1, 2, 1]).ravel())


def _traces(flat: Floats) -> Floats:
    """(c, m) traces of rows of normal matrices (c, 6 m)."""
    return np.asarray(flat.reshape(len(flat), -1, 6)[:, :, [0, 3, 5]].sum(axis=2))


def _axes(cells: Cells, found: Floats) -> Ints:
    """(c,) the axis along which to cut: the longest seen from the centre; the depth only where it matters."""
    equator = np.maximum(np.abs(cells.middle[:, 1]) - cells.half[:, 1], 0.0)
    width = np.column_stack([cells.half[:, 0] * np.cos(equator), cells.half[:, 1]])
    longest = cells.half[:, 2] > cells.middle[:, 2] * width.max(axis=1)
    matters = (cells.maybe != 0).any(axis=1) | ~np.isfinite(found[:, 0])
    return np.asarray(np.where(np.where(matters, longest, found[:, 2] > found[:, 1]), 2, width.argmax(axis=1)))


def _some(counts: list[int]) -> list[int]:
    """Of ascending numbers the largest, the one in the middle of the logarithms, and 0, where the bound is f1 itself.

    A choice of the Z_j for one number of images is within half a per cent of the best for most others.
    """
    free = np.array([count for count in counts if count])
    if not len(free):
        return counts
    middle = free[np.abs(np.log(free) - 0.5 * np.log(free[0] * free[-1])).argmin()]
    return sorted({*(count for count in counts if count == 0), int(middle), int(free[-1])})


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


def _sigma_table(camera: Camera, tag_size: float, near: float, far: float, reach: float) -> Floats:
    """focal² / sigma², at most, over depth and cosine of the incidence; last row: lowest depth and step of the depth.

    Sigma falls with a larger image of the tag and with a smaller incidence, so each bin takes its best corner.
    """
    focal = float(camera.focal_px.max())
    if camera.corner_noise is None:
        return np.array([[focal**2 / camera.sigma_px**2], [0.0]])
    lowest, step = near - reach, (far - near + 2.0 * reach) / 256
    depth = np.maximum(lowest + step * (np.arange(256) - 1), 1e-6)
    cosine = (np.arange(256) + 1) / 256.0
    edge = float(np.sqrt(camera.focal_px.prod())) * tag_size / depth
    sigma = corner_sigma(camera, edge[:, None], np.arccos(cosine)[None])
    last = np.zeros((1, 256))
    last[0, :2] = lowest, step
    return np.ascontiguousarray(np.concatenate([focal**2 / sigma**2, last]))
