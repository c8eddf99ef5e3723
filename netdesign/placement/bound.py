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
stations (``station_cells``, ``information``), where a tag counts as seen if it cannot be excluded. Cells that may hold
more than the best station known are cut (branch and bound); the stations that stand out become candidates, and the
weights are solved again. Where lines of sight end there are places between stations that see this and stations that see
that; the smallest cells there, which admit both, are candidates as well: the bound has to live with them.

The closed form 1.5 sigma² / Σ S⁻² per point is the special case of isotropic Z_j with every point's own best
viewpoints; the relaxation, which has to share its viewpoints among the points, is never weaker.

Distortion counts by its largest gain at the radius where a point appears, unequal focal lengths by the larger one.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.frames import look_at
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.photogrammetry.visibility import Sight
from netdesign.placement.information import most_information, quadratic_forms
from netdesign.placement.optimal_design import information_of, inverses, optimal_weights, squares
from netdesign.placement.sighting_weight import gain_table, weight_table
from netdesign.placement.station_cells import Cells, StationCells, reach
from netdesign.placement.visibility_map import field_bounds, unpacked

CANDIDATE_STEP = np.radians(5.0)
FINER_STEP = np.radians(1.5)  # for tags that fewer than SHY candidates see
SHY = 20
ROUNDS, ITERATIONS = 30, 100  # solutions of the weights; the next round goes on where one has stopped
BUDGET = 150_000  # cells and stations looked at for one choice of the Z_j
BATCH = 4000  # cells that are cut at a time
TRIED = 200  # of their parts, the highest ones, whose own stations are looked at
SLACK = 0.3  # share of the gap between the best station and the mean that cells may exceed it by
FINEST = np.radians(0.02)  # cells within that angle are not cut: they count as stations
NEW, APART = 300, np.radians(3.0)  # candidates of a round, and how far they are from each other
# Stop when the bound is this close to the relaxation's own value, or two rounds raise it by less than a fifth of this.
TOLERANCE, PATIENCE = 5e-3, 2
# Taken off every bound: more than the rounding of the sums.
ROUNDING = 1e-9
STEPS = 100  # of the progress of one choice

Report = Callable[[float, str], None]
"""Called with the share of the budget that is used and how good the bound is."""


def lower_bounds(task: Task, sizes: Iterable[int], progress: Progress = silent) -> dict[int, float]:
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
    chosen = _some(free) if existing else free[:1]
    proved = []
    for number, count in enumerate(chosen):

        def report(share: float, note: str, number: int = number) -> None:
            progress("lower bound", number * STEPS + min(int(share * STEPS), STEPS - 1), len(chosen) * STEPS, note)

        proved.append(certificate.proof(count, report))
    progress("lower bound", len(chosen) * STEPS, len(chosen) * STEPS)
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
        self.task = task
        self.points = np.ascontiguousarray(targets.points - sphere.centre)
        self.normals = np.ascontiguousarray(targets.point_normals)
        self.gains = gain_table(camera, float(field_bounds(camera, task.limits, True)[1]))
        near, far = reach(sphere)
        size = float(np.linalg.norm(self.points, axis=1).max())
        self.sigmas = weight_table(camera, targets.size_m, (near - size, far + size), task.limits.max_incidence)
        seen = Sight(task.scene, camera, task.limits).look(task.existing).visible
        self.fixed = information_of(task, task.existing, seen).sum(axis=0)
        self.space = StationCells(task)
        self.flat = self._sampled()
        self.cells, self.looked = self.space.first(), 0

    def proof(self, count: int, report: Report = lambda share, note: None) -> Proof | None:
        """Return what a good choice of Z proves for ``count`` images beside the existing ones; None: nothing."""
        share = self.fixed / max(count, 1)
        if not (_traces(self.flat + share) > 0.0).any(axis=0).all():
            return None
        if not count:
            seen = (_traces(self.fixed[None]) > 0.0).all()
            return self._proof(inverses(self.fixed[None], np.ones(1)), np.inf) if seen else None
        flat, weights = self.flat, np.full(len(self.flat), 1.0 / len(self.flat))
        self.cells = self.space.first()  # cut for this choice alone: what another one needs would only cost time
        best: Proof | None = None
        stalled, self.looked = 0, 0
        for number in range(ROUNDS):
            keep, weights = optimal_weights(flat + share, weights, ITERATIONS)
            flat = flat[keep]
            inverse = inverses(flat + share, weights)
            form = squares(inverse)
            mean = float(weights @ (flat @ form.ravel()))
            largest, outstanding = self._cut(form, mean)
            found = self._proof(inverse, largest)
            before = best.bound(count) if best else 0.0
            best = found if found.bound(count) > before else best
            report(self.looked / BUDGET, f"round {number + 1}, open {max(largest / mean - 1.0, 0.0):.1%}")
            stalled = stalled + 1 if 0.0 < found.bound(count) <= (1.0 + 0.2 * TOLERANCE) * before else 0
            if largest <= (1.0 + TOLERANCE) * mean or stalled == PATIENCE or self.looked > BUDGET:
                break
            new = self._matrices(outstanding)
            new = new[new @ form.ravel() > mean]
            if len(new):
                flat = np.concatenate([flat, new])
                weights = np.concatenate([0.9 * weights, np.full(len(new), 0.1 / len(new))])
        return best

    def _proof(self, inverse: Floats, largest: float) -> Proof:
        trace, fixed = float(inverse[[0, 3, 5]].sum()), float(self.fixed @ squares(inverse).ravel())
        return Proof(trace=trace, fixed=fixed, largest=largest, coordinates=3 * len(self.points))

    def _cut(self, form: Floats, mean: float) -> tuple[float, Cells]:
        """Return the largest h, proved, and stations that stand out.

        Cells are cut until none can hold much more than the best station: a share of what is wrong with the weights.
        """
        forms = quadratic_forms(_symmetric(form), self.points)
        found = self._largest(self.cells, forms)
        self.looked += len(found)
        best, known, values = mean, self.cells.take(slice(0, 0)), np.zeros(0)
        while True:
            fine = self.cells.within(FINEST)
            best = max(best, float(found[fine, 0].max(initial=0.0)))  # infinite: nothing can be proved
            limit = best + max(0.5 * TOLERANCE * mean, SLACK * (best - mean))
            above = np.flatnonzero((found[:, 0] > limit) & ~fine)
            if not len(above) or self.looked > BUDGET:
                break
            if len(above) > BATCH:
                above = np.sort(above[np.argsort(-found[above, 0], kind="stable")[:BATCH]])
            rest = np.ones(len(self.cells), np.bool_)
            rest[above] = False
            parts = self.space.parts(self.cells.take(above), _axes(self.cells.take(above), found[above]))
            added = self._largest(parts, forms)
            self.cells, found = self.cells.take(rest).joined(parts), np.concatenate([found[rest], added])
            tried = self.space.samples(parts.take(np.argsort(-added[:, 0], kind="stable")[:TRIED]))
            reached = self._largest(tried, forms)[:, 0]
            self.looked += len(added) + len(tried)
            best = max(best, float(reached.max(initial=0.0)))
            high = reached > mean
            known, values = known.joined(tried.take(high)), np.concatenate([values, reached[high]])
        fine &= found[:, 0] > mean
        known, values = known.joined(self.cells.take(fine).points), np.concatenate([values, found[fine, 0]])
        return float(found[:, 0].max(initial=0.0)), _spread(known, values)

    def _largest(self, cells: Cells, forms: Floats) -> Floats:
        """(c, 3) of ``most_information``."""
        found: Floats = most_information(
            cells.directions, cells.depths, cells.deltas, cells.possible, self.points, self.normals, forms, self.gains,
            self.sigmas,
        )  # fmt: skip
        return found

    def _sampled(self) -> Floats:
        """(c, 6 m) of stations all over the admissible set, more of them for tags that few of these see."""
        every = np.ones(self.space.tag_count, np.bool_)
        flat = self._matrices(self._lattice(CANDIDATE_STEP, every))
        seen = _traces(flat) > 0.0
        shy = ((seen.sum(axis=0) < SHY) & ~(_traces(self.fixed[None])[0] > 0.0))[::CORNERS_PER_TAG]
        if shy.any():
            finer = self._lattice(FINER_STEP, shy)
            sees = np.flatnonzero((finer.sure != 0).any(axis=1))
            rows = np.linspace(0, len(sees) - 1, min(len(sees), SHY * int(shy.sum()))).astype(int)
            places = finer.middle[sees[rows]]
            more = self.space.stations(places, self.space.words(every, len(places)))
            flat = np.concatenate([flat, self._matrices(more)])
        return flat

    def _lattice(self, step: float, tags: Bools) -> Cells:
        """Stations at equal steps, rad, with those of the tags (g,) that they see."""
        sphere = self.task.sphere
        surface = sphere.depth is not None and not sphere.depth.has_width  # ``sample`` doubles the step of a depth
        viewpoints = sphere.sample(0.5 * step if surface else step)[0]
        places = np.column_stack([viewpoints[:, :2], sphere.radii(viewpoints)])
        places = places[places[:, 2] > 0.0]  # a box may hold the centre itself
        return self.space.stations(places, self.space.words(tags, len(places)))

    def _matrices(self, stations: Cells) -> Floats:
        """(c, 6 m) normal matrices of stations with the tags that they see."""
        sphere, tags = self.task.sphere, unpacked(stations.sure, self.space.tag_count)
        poses = look_at(sphere.centre + stations.middle[:, 2:] * stations.directions, sphere.centre, sphere.roll or 0.0)
        return information_of(self.task, poses, np.repeat(tags, CORNERS_PER_TAG, axis=1))


def _spread(stations: Cells, values: Floats) -> Cells:
    """Of stations that lie close together, as seen from the centre, the one with the largest value."""
    order = np.argsort(-values, kind="stable")
    place = np.column_stack([stations.directions / APART, np.log(stations.middle[:, 2]) / APART])[order]
    _, first = np.unique(np.round(place), axis=0, return_index=True)
    return stations.take(order[np.sort(first)[:NEW]])


def _symmetric(form: Floats) -> Floats:
    """(m, 3, 3) Y of ``squares``."""
    return np.asarray((form * [1.0, 0.5, 0.5, 1.0, 0.5, 1.0])[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))


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
    """Of ascending numbers the ends, the one in the middle of the logarithms, and 0, where the bound is f1 itself.

    A choice of the Z_j for one number of images is within half a per cent of the best for most others.
    """
    free = np.array([count for count in counts if count])
    if not len(free):
        return counts
    middle = free[np.abs(np.log(free) - 0.5 * np.log(free[0] * free[-1])).argmin()]
    return sorted({*(count for count in counts if count == 0), int(free[0]), int(middle), int(free[-1])})
