"""A resolved study: everything the verbs work on, in SI units, meshes loaded."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from netdesign.model.arrays import Floats, frozen
from netdesign.model.camera import Camera
from netdesign.model.scene import Scene
from netdesign.model.stations import ViewingSphere
from netdesign.model.study import Study


@dataclass(frozen=True, kw_only=True)
class VisibilityLimits:
    """When a tag counts as seen (contract, section 5), and how much of it a network needs.

    Attributes:
        max_incidence: rad.  min_tag_px: shortest of a tag's four edges.  border_px: margin of the frame.
        min_rays: images per object point.  min_points_per_image: object points in every image.
    """

    max_incidence: float
    min_tag_px: float
    border_px: float
    min_rays: int
    min_points_per_image: int
    occlusion: bool


@dataclass(frozen=True, kw_only=True)
class RobotCell:
    """The arm, where it stands and what it must not touch. SI units.

    Attributes:
        urdf: path of the URDF; package_dirs: where its package:// meshes lie.
        tool_frame: frame that carries the camera, None for the robot's own flange.
        world_from_base, flange_from_cam: (4, 4) m.
        lock: joint name to fixed value in rad.  limits: joint name to (low, high) in rad, instead of the URDF's.
        joint_weights: lambda of the source paper, None for all 1.
        obstacle_centres, obstacle_sizes: (b, 3) m, world-axis-aligned boxes.
        margin: m, distance the robot keeps from everything that is not itself.
        home: rad, where a program starts and ends; None: at the first and the last station.
        repeatability: sigma per axis of the camera's pose, (position m, rotation rad); 0: not known.
        camera_radius, camera_length: m, the camera's body: a rounded cylinder behind the perspective centre.
    """

    name: str
    urdf: Path
    package_dirs: tuple[Path, ...]
    tool_frame: str | None
    world_from_base: Floats
    flange_from_cam: Floats
    lock: dict[str, float] = field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    joint_weights: tuple[float, ...] | None = None
    speed: float = 1.05
    acceleration: float = 1.4
    dwell: float = 0.5
    margin: float = 0.02
    obstacle_centres: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    obstacle_sizes: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    home: tuple[float, ...] | None = None
    repeatability: tuple[float, float] = (0.0, 0.0)
    camera_radius: float = 0.03
    camera_length: float = 0.09

    def __post_init__(self) -> None:
        object.__setattr__(self, "world_from_base", frozen("world_from_base", self.world_from_base, (4, 4)))
        object.__setattr__(self, "flange_from_cam", frozen("flange_from_cam", self.flange_from_cam, (4, 4)))
        object.__setattr__(self, "obstacle_centres", frozen("obstacle_centres", self.obstacle_centres, ("b", 3)))
        object.__setattr__(self, "obstacle_sizes", frozen("obstacle_sizes", self.obstacle_sizes, ("b", 3)))


@dataclass(frozen=True, kw_only=True)
class Task:
    """One resolved study.

    Attributes:
        study: the file as read, for names, seeds and settings without a unit.
        sha256: of the resolved study text and its inputs, hexadecimal.
        left_out: ids of tags that are seen from less than ``targets.min_seen_share`` of the sphere: not in the scene.
    """

    study: Study
    scene: Scene
    camera: Camera
    sphere: ViewingSphere
    limits: VisibilityLimits
    cell: RobotCell | None
    sha256: str
    existing: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def __post_init__(self) -> None:
        object.__setattr__(self, "existing", frozen("existing", self.existing, ("e", 4, 4)))

    left_out: tuple[int, ...] = ()
