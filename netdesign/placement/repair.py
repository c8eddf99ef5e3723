"""A network that stands: what each of its images is worth, and which image would serve it best next.

Limited propagation adds up image by image: N = Σ_i M_i for every point. Without image i it is N - M_i, with one more
N + M, so that all of it is exact (rays, distortion, sigma per sighting) and cheap for any pose, on the viewing sphere
or not. A new station is looked for over the whole admissible set: a lattice first, then steps around the best of it.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.motion.options import search_options
from netdesign.photogrammetry.limited_error import variances_of
from netdesign.photogrammetry.visibility import Sight
from netdesign.placement.distances import network_total_error
from netdesign.placement.encoding import Chromosomes
from netdesign.placement.optimal_design import information_of

LATTICE = 600  # stations looked at first
BEST, ROUNDS, STEPS = 6, 6, 24  # of them carried on, and steps around each
FIRST_STEP, LAST_STEP = np.radians(4.0), np.radians(0.1)


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What a network is worth.

    Attributes:
        images: n.  f1: mean variance of the limited propagation, m², inf when a point is not determined.
        worst: largest sigma of a coordinate, m.  total_rms: rms sigma with total propagation, m, None: not determined.
        rays: fewest of a point.  short: points with fewer than min_rays.  poor: images with too few points.
    """

    images: int
    f1: float
    worst: float
    total_rms: float | None
    rays: int
    short: int
    poor: int


@dataclass(frozen=True, kw_only=True)
class Addition:
    """A new station and the network with it."""

    viewpoint: Floats
    world_from_cam: Floats
    quality: Quality


class Standing:
    """A study's scene and robot, prepared for questions about one network after the other."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.sight = Sight(task.scene, task.camera, task.limits)
        self.space = Chromosomes(sphere=task.sphere, slots=1)
        moving = task.cell is not None and task.study.motion != "workspace"
        self.joint_map = JointMap.build(task.cell, task.sphere, task.scene.part) if moving and task.cell else None

    def quality(self, world_from_cam: Floats) -> Quality:
        """Return what images with poses (n, 4, 4) are worth together."""
        visible = self.sight.look(world_from_cam).visible
        normal = information_of(self.task, world_from_cam, visible).sum(axis=0).reshape(-1, 6)
        return self._quality(world_from_cam, visible, normal)

    def drops(self, world_from_cam: Floats) -> list[Quality]:
        """Return, for each of n >= 1 images, the network without it."""
        visible = self.sight.look(world_from_cam).visible
        each = information_of(self.task, world_from_cam, visible).reshape(len(visible), -1, 6)
        rest = [np.delete(np.arange(len(visible)), image) for image in range(len(visible))]
        return [self._quality(world_from_cam[rows], visible[rows], each[rows].sum(axis=0)) for rows in rest]

    def addition(self, world_from_cam: Floats) -> Addition | None:
        """Return the station that serves the network best; None when no admissible one sees enough.

        Best: fewest missing rays, then fewest undetermined points, then the least f1.
        """
        visible = self.sight.look(world_from_cam).visible
        normal = information_of(self.task, world_from_cam, visible).sum(axis=0).reshape(-1, 6)
        rays = visible.sum(axis=0)
        rng = np.random.default_rng([self.task.study.seed, len(world_from_cam)])
        viewpoints = self._usable(self.space.spread(LATTICE))
        if not len(viewpoints):
            return None
        order = np.lexsort(self._merits(viewpoints, normal, rays).T[::-1])
        found = []
        for viewpoint in viewpoints[order[:BEST]]:
            best, merit = viewpoint, self._merits(viewpoint[None], normal, rays)[0]
            for step in np.geomspace(FIRST_STEP, LAST_STEP, ROUNDS):
                around = self.space.stepped(
                    np.tile(best, (STEPS, 1)), rng.uniform(-np.pi, np.pi, STEPS), step * rng.uniform(0.2, 1.0, STEPS)
                )
                around = self._usable(around)
                if not len(around):
                    continue
                merits = self._merits(around, normal, rays)
                row = int(np.lexsort(merits.T[::-1])[0])
                if tuple(merits[row]) < tuple(merit):
                    best, merit = around[row], merits[row]
            found.append((tuple(merit.tolist()), best))
        best = min(found, key=lambda item: item[0])[1]
        pose = self.task.sphere.cameras(best[None])
        return Addition(
            viewpoint=best, world_from_cam=pose[0], quality=self.quality(np.concatenate([world_from_cam, pose]))
        )

    def _usable(self, viewpoints: Floats) -> Floats:
        """The viewpoints within reach that see enough for an image."""
        if self.joint_map is not None:
            viewpoints = viewpoints[[len(joints) > 0 for joints in search_options(self.joint_map, viewpoints)]]
        seen = self.sight.look(self.task.sphere.cameras(viewpoints)).visible.sum(axis=1)
        return np.asarray(viewpoints[seen >= max(self.task.limits.min_points_per_image, 1)])

    def _merits(self, viewpoints: Floats, normal: Floats, rays: Ints) -> Floats:
        """(c, 3) missing rays, undetermined points and f1 of the rest, with each of the viewpoints added."""
        poses = self.task.sphere.cameras(viewpoints)
        visible = self.sight.look(poses).visible
        added = information_of(self.task, poses, visible).reshape(len(visible), -1, 6)
        missing = np.maximum(self.task.limits.min_rays - rays - visible, 0).sum(axis=1)
        trace = variances_of(normal + added).sum(axis=2)
        determined = np.isfinite(trace)
        f1 = np.where(determined, trace, 0.0).sum(axis=1) / (3 * len(rays))
        return np.stack([missing, (~determined).sum(axis=1), f1], axis=1).astype(np.float64)

    def _quality(self, world_from_cam: Floats, visible: Bools, normal: Floats) -> Quality:
        rays = visible.sum(axis=0)
        variances = variances_of(normal)
        total = network_total_error(self.task, world_from_cam, visible) if len(world_from_cam) > 1 else None
        determined = total is not None and total.determined
        return Quality(
            images=len(world_from_cam),
            f1=float(variances.mean()),
            worst=float(np.sqrt(variances.max())),
            total_rms=float(np.sqrt(total.precision.mean_variance)) if determined and total is not None else None,
            rays=int(rays.min()),
            short=int((rays < self.task.limits.min_rays).sum()),
            poor=int((visible.sum(axis=1) < self.task.limits.min_points_per_image).sum()),
        )
