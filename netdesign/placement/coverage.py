"""What can be seen from the viewing sphere, and what never will be: the facts behind ``netdesign check``."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from netdesign.errors import InfeasibleError
from netdesign.model.arrays import Bools, Floats
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.photogrammetry.connectivity import components, listed
from netdesign.photogrammetry.visibility import REASONS, SAMPLE_STEP, SEEN, sightings
from netdesign.placement.visibility_map import VisibilityMap


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Sightings of every tag from a grid over the sphere, and what the map proves.

    Attributes:
        tag_ids: (g,).
        viewpoints: (c, 2) alpha, beta of the sampled viewpoints, rad, roll 0 when it is free.
        weights: (c,) share of the admissible sphere each of them stands for, sum 1.
        reason: (c, g) int8, index into REASONS: exact rays.
        never: (g,) no admissible viewpoint sees the tag: proved, not sampled.
        lonely: (g,) seen, but from nowhere together with enough others for ``min_points_per_image``: proved.
        admissible: share of the sphere from which an image holds ``min_points_per_image`` points.
        least_images: proven lower bound on the number of images that give every point its ``min_rays``; 0 when some
            tag is never or lonely, so that no number is enough.
        groups: ids of tags by groups that no image can tie together: no viewpoint sees tags of two of them. One group
            where something of the above is wrong already, or where existing stations may tie them.
        max_images, min_rays, min_points_per_image: of the study.
        proved: False when there is no map, and never, lonely, groups and least_images are those of the sample.
    """

    tag_ids: NDArray[np.int64]
    viewpoints: Floats
    weights: Floats
    reason: NDArray[np.int8]
    never: Bools
    lonely: Bools
    admissible: float
    least_images: int
    groups: tuple[tuple[int, ...], ...]
    max_images: int
    min_rays: int
    min_points_per_image: int
    proved: bool = True

    @property
    def share(self) -> Floats:
        """(g,) share of the admissible sphere from which each tag is seen."""
        return np.asarray(self.weights @ (self.reason == SEEN))

    @property
    def refusals(self) -> dict[str, int]:
        """How many of the sampled sightings ended with each of REASONS, "seen" included."""
        return dict(zip(REASONS, np.bincount(self.reason.ravel(), minlength=len(REASONS)).tolist(), strict=True))

    @property
    def main_reason(self) -> tuple[str, ...]:
        """(g,) why each tag is not seen where it is not, by area; "seen" when it is seen from everywhere."""
        shares = np.stack([self.weights @ (self.reason == k) for k in range(1, len(REASONS))])
        worst = shares.argmax(axis=0) + 1
        return tuple(REASONS[k] if shares[k - 1, g] > 0 else REASONS[SEEN] for g, k in enumerate(worst))

    @property
    def obstacles(self) -> tuple[str, ...]:
        """One line for everything that makes the study infeasible; empty when nothing is proved against it."""
        lines = []
        unseen = np.flatnonzero(self.never)
        if unseen.size:
            reasons = [self.main_reason[g] for g in unseen]
            counts = ", ".join(f"{reasons.count(name)} by {name}" for name in REASONS if name in reasons)
            names = ", ".join(str(self.tag_ids[g]) for g in unseen[:8]) + (", …" if unseen.size > 8 else "")
            kind = "admissible" if self.proved else "sampled"
            lines.append(
                f"{unseen.size} of {len(self.never)} tags ({CORNERS_PER_TAG * unseen.size} object points) are seen "
                f"from no {kind} viewpoint (refused mostly: {counts}): tags {names}; targets.min_seen_share = 0.01 "
                "leaves such tags out"
            )
        if self.lonely.any():
            lines.append(
                f"visibility.min_points_per_image: {int(self.lonely.sum())} tag(s) are seen only from viewpoints where "
                f"fewer than {self.min_points_per_image} object points are in view"
            )
        if not lines and self.least_images > self.max_images:
            lines.append(
                f"viewpoints.max_images: at least {self.least_images} images are needed to give every object point "
                f"{self.min_rays} rays, allowed are {self.max_images}"
            )
        if not lines and len(self.groups) > 1:
            sizes = [f"{len(group)} ({listed([str(tag) for tag in group], 3)})" for group in self.groups]
            lines.append(
                f"the tags fall into {len(self.groups)} groups of which no {'' if self.proved else 'sampled '}"
                f"viewpoint sees two, so that images of one cannot be tied to those of another: {listed(sizes)}; they "
                "need studies of their own, tags between them, or a larger visibility.max_incidence_deg"
            )
        return tuple(lines)

    def demand_feasible(self) -> None:
        """Return when nothing is proved against the study.

        Raises:
            InfeasibleError: with every one of ``obstacles``.
        """
        if self.obstacles:
            raise InfeasibleError("; ".join(self.obstacles))


def coverage(task: Task, visibility_map: VisibilityMap | None = None) -> Coverage:
    """Sample the sphere at two degrees with exact rays, and read from the map what is proved. A second of work.

    Stations that are not on one sphere have no map: what the sample says is then all there is.
    """
    scene, sphere, limits = task.scene, task.sphere, task.limits
    proved = sphere.depth is None
    if visibility_map is None and proved:
        visibility_map = VisibilityMap.build(scene, task.camera, sphere, limits)
    viewpoints, weights = sphere.sample(SAMPLE_STEP)
    reason = sightings(scene, task.camera, sphere.cameras(viewpoints), limits).reason
    possible = np.unique(reason == SEEN, axis=0) if visibility_map is None else _distinct(visibility_map)
    enough = possible.sum(axis=1) * CORNERS_PER_TAG >= limits.min_points_per_image
    never: Bools = np.equal(possible.any(axis=0), False)
    together: Bools = np.asarray(possible[enough].any(axis=0))
    return Coverage(
        tag_ids=scene.targets.ids,
        viewpoints=viewpoints,
        weights=weights,
        reason=reason,
        never=never,
        lonely=~never & ~together,
        admissible=float(weights[(reason == SEEN).sum(axis=1) * CORNERS_PER_TAG >= limits.min_points_per_image].sum()),
        least_images=0 if not together.all() else least_images(possible[enough], limits.min_rays),
        groups=_groups(possible[enough], scene.targets.ids) if together.all() and not len(task.existing) else (),
        max_images=sphere.max_images,
        min_rays=limits.min_rays,
        min_points_per_image=limits.min_points_per_image,
        proved=proved,
    )


def _groups(possible: Bools, tag_ids: NDArray[np.int64]) -> tuple[tuple[int, ...], ...]:
    """Return the ids of tags that rows of ``possible`` (c, g) tie together, the largest group first."""
    label = components(possible)[1]
    found = [tuple(tag_ids[label == one].tolist()) for one in np.unique(label)]
    return tuple(sorted(found, key=lambda group: (-len(group), group)))


def least_images(possible: Bools, min_rays: int) -> int:
    """Return a lower bound on how many rows of ``possible`` (c, g), repeats allowed, see every tag ``min_rays`` times.

    Linear relaxation of the set cover, solved by HiGHS and made safe by its dual: for multipliers y >= 0 of the tags,
    no n images can do with n · max over rows (possible @ y) < min_rays · sum(y).
    """
    largest = possible[~_dominated(possible)].astype(np.float64)
    solution = linprog(
        np.ones(len(largest)), A_ub=-largest.T, b_ub=-np.full(possible.shape[1], float(min_rays)), method="highs"
    )
    duals = np.maximum(-np.asarray(solution.ineqlin.marginals), 0.0)
    reach = (possible @ duals).max()
    bound = min_rays * duals.sum() / reach if reach > 0 else 0.0
    return max(int(np.ceil(bound - 1e-6)), min_rays)


def _distinct(visibility_map: VisibilityMap) -> Bools:
    """The different rows of sure-or-maybe tags (c, g)."""
    rows = np.unique(visibility_map.sure | visibility_map.maybe, axis=0)
    bits = np.unpackbits(np.ascontiguousarray(rows).view(np.uint8), axis=1, bitorder="little")
    return bits[:, : visibility_map.tag_count].astype(bool)


def _dominated(rows: Bools) -> Bools:
    """(c,) rows whose tags all appear in another one, among the 2000 largest; the rest counts as dominated."""
    order = np.argsort(-rows.sum(axis=1), kind="stable")
    dominated = np.ones(len(rows), bool)
    kept = np.zeros((0, rows.shape[1]), bool)
    for index in order[:2000]:
        if not (kept | ~rows[index]).all(axis=1).any():
            dominated[index] = False
            kept = np.concatenate([kept, rows[index : index + 1]])
    return dominated
