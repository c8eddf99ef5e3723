"""Stations looked at one by one and remembered: what each sees, what it adds to every point, the arm's joints there.

No map can be drawn once and for all where stations have a depth. Children share most stations with their parents and
the local search changes one at a time, so that most of what is asked for is known.
"""

from dataclasses import dataclass, field

import numpy as np

from netdesign.model.arrays import Bools, Floats
from netdesign.model.frames import sphere_directions, viewpoints_of
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.motion.joint_lookup import LANES
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_tour import options_tour, work_for
from netdesign.motion.options import exact_options, search_options
from netdesign.motion.tour import path_length
from netdesign.photogrammetry.visibility import Sight
from netdesign.placement.optimal_design import information_of
from netdesign.placement.preparation import joint_map_of, joint_tables
from netdesign.placement.tables import JointTables
from netdesign.placement.visibility_map import field_bounds

KEPT = 20_000  # stations that are remembered
NO_LABEL, NOTHING = np.zeros((0, 0), np.int64), np.zeros((0, 0, 0, 0))  # no leg is barred in the search


@dataclass(frozen=True, kw_only=True)
class Station:
    """What one image adds.

    Attributes:
        sees: (g,) tags.  normal: (m, 6) its part of the normal matrices.  place: (3,) m.
        joints: (k, r) rad, the arm's options; none: out of reach; empty too when motion is in the workspace.
    """

    sees: Bools
    normal: Floats
    place: Floats
    joints: Floats


@dataclass(frozen=True, kw_only=True)
class KnownStations:
    """The stations of a study.

    Attributes:
        sight: the scene, prepared for rays.
        joint_map, joint: for the arm; None when motion is in the workspace.
        known: by the bytes of their genes; it changes no result.
    """

    task: Task
    sight: Sight
    joint_map: JointMap | None
    joint: JointTables | None
    known: dict[bytes, Station] = field(default_factory=dict)

    @staticmethod
    def build(task: Task) -> "KnownStations":
        """Prepare a study's scene and robot; nothing is looked at yet."""
        joint_map = joint_map_of(task)
        sight = Sight(task.scene, task.camera, task.limits)
        return KnownStations(task=task, sight=sight, joint_map=joint_map, joint=joint_tables(task, joint_map))

    def existing(self) -> tuple[Station, ...]:
        """Return the existing stations of the study, looked at as they are."""
        poses, joints = self.task.existing, None
        if self.joint_map is not None:
            options = exact_options(self.joint_map, np.zeros((0, 2)), poses)
            joints = [options.joints[row, :, :count].T for row, count in enumerate(options.count)]
        return self._looked_at(poses, self.sight.look(poses).visible_tags, joints)

    def of(self, viewpoints: Floats) -> list[Station]:
        """Return the stations of viewpoints (k, d); those that are new are looked at together."""
        keys = [viewpoint.tobytes() for viewpoint in np.ascontiguousarray(viewpoints)]
        new = list({key: row for row, key in enumerate(keys) if key not in self.known}.values())
        if len(self.known) + len(new) > KEPT:
            self.known.clear()
            new = list({key: row for row, key in enumerate(keys)}.values())
        there = self.task.sphere.admissible(viewpoints[new])
        real = viewpoints[new][there]
        poses = self.task.sphere.cameras(real)
        sees = self.sight.look(poses).visible_tags
        if self.joint_map is not None and self.task.sphere.roll is None:
            sees &= self._at_any_roll(poses)
        joints = None if self.joint_map is None else search_options(self.joint_map, real)
        looked = iter(self._looked_at(poses, sees, joints))
        targets = self.task.scene.targets
        nothing = Station(
            sees=np.zeros(len(targets.ids), np.bool_), normal=np.zeros((len(targets.points), 6)),
            place=self.task.sphere.centre, joints=np.zeros((0, 0)),
        )  # fmt: skip
        for row, is_there in zip(new, there.tolist(), strict=True):
            self.known[keys[row]] = next(looked) if is_there else nothing
        return [self.known[key] for key in keys]

    def tour(self, network: list[Station]) -> tuple[float, int]:
        """Return (f2, stations out of reach) of a network in the search: m, weighted rad, or s with the dwell.

        Stations out of reach are left out of the tour.
        """
        places = np.array([station.place for station in network])
        if self.joint is None:
            return path_length(places), 0
        rows = [row for row, station in enumerate(network) if len(station.joints)]
        length = 0.0
        if len(rows) > 1:
            count = np.array([len(network[row].joints) for row in rows], np.int64)
            options = np.zeros((len(rows), network[rows[0]].joints.shape[1], -(-int(count.max()) // LANES) * LANES))
            for own, row in zip(options, rows, strict=True):
                own[:, : len(network[row].joints)] = network[row].joints.T
            # Over the angles: a station may stand at the centre itself.
            directions = sphere_directions(viewpoints_of(places[rows] - self.task.sphere.centre))
            law, timed, work = self.joint.law, self.joint.timed, work_for(*options.shape)
            length = float(options_tour(options, count, directions, NO_LABEL, NOTHING, law, timed, work))
        return length + self.joint.dwell * len(network), len(network) - len(rows)

    def _looked_at(self, poses: Floats, sees: Bools, joints: list[Floats] | None) -> tuple[Station, ...]:
        if not len(poses):
            return ()
        visible = np.repeat(sees, CORNERS_PER_TAG, axis=1)
        normal = information_of(self.task, poses, visible).reshape(len(poses), -1, 6)
        options = [np.zeros((0, 0))] * len(poses) if joints is None else joints
        return tuple(
            Station(sees=tags, normal=part, place=pose[:3, 3], joints=q)
            for tags, part, pose, q in zip(sees, normal, poses, options, strict=True)
        )

    def _at_any_roll(self, poses: Floats) -> Bools:
        """(k, g) tags whose corners are in the frame however the arm turns the camera about its axis."""
        inner = field_bounds(self.task.camera, self.task.limits, True)[0]
        offset = self.task.scene.targets.points - poses[:, None, :3, 3]
        inside = offset @ poses[:, :3, :3]
        within = np.hypot(inside[..., 0], inside[..., 1]) <= inner * inside[..., 2]
        return np.asarray(within.reshape(len(poses), len(self.task.scene.targets.ids), CORNERS_PER_TAG).all(axis=2))
