"""The study file, key by key: the only place where defaults live.

Keys carry their unit; ``files/study.py`` reads the TOML, resolves paths and converts to SI values.
An unknown key, a wrong type or a value out of range is an error that names the table and the key.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = tuple[Number, Number, Number]
Range = tuple[Number, Number]
Axes = tuple[Positive, Positive, Positive]


class Table(BaseModel):
    """A strict table: no unknown keys, frozen once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class PartTable(Table):
    """[part]: the CAD mesh and its pose in the world frame."""

    mesh: str = Field(description="path of any mesh trimesh reads, or package:// of an installed robot package")
    unit: Literal["mm", "m", "inch"] = Field("mm", description="length unit of the mesh file")
    position_mm: Vector3 = Field((0, 0, 0), description="origin of the mesh frame in the world frame")
    rotation_deg: Vector3 = Field((0, 0, 0), description="roll, pitch, yaw of the mesh frame (URDF order)")


class TargetsTable(Table):
    """[targets]: AprilTags, in the mesh frame; from a file, or spread over the faces."""

    family: Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"] = Field("tag36h11", description="of AprilTags")
    size_mm: Positive = Field(description="edge of the black square")
    file: str | None = Field(None, description="CSV: tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz")
    spacing_mm: Positive | None = Field(None, description="instead of file: grid spacing of tags on every large face")
    min_seen_share: Annotated[float, Field(ge=0, lt=1)] = Field(
        0, description="tags seen from a smaller share of the admissible sphere are left out; 0: every tag must be seen"
    )

    @model_validator(mode="after")
    def _one_source(self) -> "TargetsTable":
        if (self.file is None) == (self.spacing_mm is None):
            raise ValueError("expected exactly one of file and spacing_mm")
        return self


class CameraTable(Table):
    """[camera]: interior orientation, optics, sensor, noise."""

    width_px: Annotated[int, Field(gt=0, le=20000)]
    height_px: Annotated[int, Field(gt=0, le=20000)]
    focal_px: tuple[Positive, Positive]
    principal_point_px: tuple[Number, Number]
    distortion: tuple[Number, Number, Number, Number] = Field((0, 0, 0, 0), description="OpenCV's k1, k2, p1, p2")
    pixel_um: Positive | None = Field(None, description="pixel pitch; with f_number and focus_mm: depth of field")
    f_number: Positive | None = None
    focus_mm: Positive | None = None
    dof_blur_px: Positive = Field(2.0, description="largest circle of confusion that counts as sharp")
    sigma_px: Positive = Field(0.1, description="image-coordinate noise per coordinate, where noise is constant")
    noise: Literal["constant", "detector"] = Field(
        "constant", description="detector: the fitted model of the detector, which takes the place of sigma_px"
    )
    noise_file: str | None = Field(None, description="written by calibrate-noise; default: the shipped calibration")
    blur_px: Positive = Field(0.7, description="Gaussian sigma of the optics")
    full_well_e: Positive = Field(1500, description="electrons at white")
    read_noise_e: NotNegative = 8

    @model_validator(mode="after")
    def _noise_file_is_used(self) -> "CameraTable":
        if self.noise_file is not None and self.noise != "detector":
            raise ValueError('noise_file: expected noise = "detector" beside it, found noise = "constant"')
        return self


def _single_or_pair(value: object) -> str:
    return "pair" if isinstance(value, (list, tuple)) and len(value) == 2 else "single"


class ViewpointsTable(Table):
    """[viewpoints]: where cameras may stand: one of radius_mm, semi_axes_mm and box_mm. All look at centre_mm."""

    centre_mm: Vector3 = (0, 0, 0)
    radius_mm: (
        Annotated[
            Annotated[Positive, Tag("single")] | Annotated[tuple[Positive, Positive], Tag("pair")],
            Discriminator(_single_or_pair),
        ]
        | None
    ) = Field(None, description="of the viewing sphere; [least, largest]: any distance between the two")
    semi_axes_mm: (
        Annotated[
            Annotated[Axes, Tag("single")] | Annotated[tuple[Axes, Axes], Tag("pair")], Discriminator(_single_or_pair)
        ]
        | None
    ) = Field(None, description="of an ellipsoid about the centre, along x, y, z; [inner, outer]: between the two")
    box_mm: tuple[Vector3, Vector3] | None = Field(
        None, description="lowest and highest corner in the world frame; stations anywhere inside"
    )
    elevation_deg: Range = (10, 90)
    azimuth_deg: Range = (-180, 180)
    roll_deg: Number | Literal["free"] = Field(0, description="about the optical axis; free: the robot chooses")
    max_images: Annotated[int, Field(ge=2, le=60)] = 16
    existing: str | None = Field(
        None, description="stations that every network contains: design.json#ID, CSV of export, COLMAP images.txt"
    )

    @model_validator(mode="after")
    def _one_shape(self) -> "ViewpointsTable":
        given = [name for name in ("radius_mm", "semi_axes_mm", "box_mm") if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"expected exactly one of radius_mm, semi_axes_mm and box_mm, found {found}")
        low, high = self.extent_mm
        if any(one > other for one, other in zip(low, high, strict=True)) or (self.box_mm and low == high):
            found = str(getattr(self, given[0])).translate(str.maketrans("()", "[]"))
            raise ValueError(f"{given[0]}: expected low <= high, found {found}")
        return self

    @property
    def extent_mm(self) -> tuple[Axes, Axes]:
        """Semi-axes of the inner and outer ellipsoid, or the corners of the box; equal for a plain sphere."""
        if self.box_mm is not None:
            return self.box_mm
        if self.semi_axes_mm is not None:
            axes = self.semi_axes_mm
            return axes if len(axes) == 2 else (axes, axes)
        low, high = self.radius_mm if isinstance(self.radius_mm, tuple) else (self.radius_mm, self.radius_mm)
        return (low,) * 3, (high,) * 3  # type: ignore[return-value]

    @model_validator(mode="after")
    def _ordered(self) -> "ViewpointsTable":
        for name, limit in (("elevation_deg", 90), ("azimuth_deg", 360)):
            low, high = getattr(self, name)
            if not (-limit <= low < high <= limit):
                raise ValueError(f"{name}: expected low < high within ±{limit}, found [{low}, {high}]")
        if self.azimuth_deg[1] - self.azimuth_deg[0] > 360:
            raise ValueError("azimuth_deg: expected a range of at most 360")
        return self


class VisibilityTable(Table):
    """[visibility]: when a tag counts as seen, and how much of it a network needs."""

    max_incidence_deg: Annotated[float, Field(gt=0, lt=90)] = 65
    min_tag_px: NotNegative = 25
    border_px: NotNegative = 10
    min_rays: Annotated[int, Field(ge=2)] = Field(3, description="images per object point")
    min_points_per_image: Annotated[int, Field(ge=0)] = 8
    occlusion: bool = True


class Obstacle(Table):
    """A box, axis-aligned in the world frame, that the robot must not touch."""

    box_mm: tuple[Positive, Positive, Positive] = Field(description="edge lengths")
    position_mm: Vector3 = Field(description="centre in the world frame")


class RobotTable(Table):
    """[robot]: the arm, its place, the camera on its flange, and how fast it moves."""

    name: str | None = Field(None, description="a robot of example-robot-data: ur10, ur5, ur3, panda, xarm7, …")
    urdf: str | None = Field(None, description="instead of name")
    package_dirs: tuple[str, ...] = ()
    tool_frame: str | None = Field(None, description="frame that carries the camera; default: the robot's flange")
    base_position_mm: Vector3 = (-600, 0, 0)
    base_rotation_deg: Vector3 = (0, 0, 0)
    camera_mount: Literal["side", "coaxial"] = "side"
    flange_from_cam_mm: tuple[tuple[Number, ...], ...] | None = Field(
        None, description="4x4, instead of camera_mount; three or more digits are made a rotation"
    )
    lock: dict[str, Number] = Field(default_factory=dict, description="joint name = value in rad, not moved")
    limits_rad: dict[str, Range] = Field(default_factory=dict, description="joint name = [low, high], instead of URDF")
    joint_weights: tuple[NotNegative, ...] | None = Field(None, description="lambda of the source paper; default all 1")
    speed_rad_s: Positive = 1.05
    acceleration_rad_s2: Positive = 1.4
    dwell_s: NotNegative = 0.5
    margin_mm: NotNegative = Field(
        20,
        description="kept from part and obstacles; links 1 and 2: except from what the base stands on",
    )
    obstacles: tuple[Obstacle, ...] = ()
    home_rad: tuple[Number, ...] | None = Field(
        None, description="joints where a program starts and ends; the ways there are checked, and are not in f2"
    )
    repeatability_mm: NotNegative = Field(0, description="sigma per axis of the camera's position; 0: not known")
    repeatability_mrad: NotNegative = Field(
        0, description="the same of its rotation; both: pose priors, absolute sigma"
    )

    @model_validator(mode="after")
    def _one_robot(self) -> "RobotTable":
        if (self.name is None) == (self.urdf is None):
            raise ValueError("expected exactly one of name and urdf")
        matrix = self.flange_from_cam_mm
        if matrix is not None and [len(row) for row in matrix] != [4, 4, 4, 4]:
            raise ValueError("flange_from_cam_mm: expected a 4x4 matrix")
        return self


class ObjectivesTable(Table):
    """[objectives]: what is minimised."""

    precision: Literal["mean_variance", "max_sigma"] = "mean_variance"
    propagation: Literal["limited", "block", "total"] = Field(
        "limited", description="block: between the two, each image by itself; of the mean variance only"
    )
    motion: Literal["workspace", "joint", "time"] | None = Field(
        None, description="default: joint with a robot, else workspace"
    )

    @model_validator(mode="after")
    def _block_has_no_points(self) -> "ObjectivesTable":
        if self.propagation == "block" and self.precision != "mean_variance":
            raise ValueError(f"propagation: block propagation gives the mean variance only, found {self.precision!r}")
        return self


class DistanceRequirement(Table):
    """The expanded uncertainty (k = 2) of one distance between two object points."""

    from_: str = Field(alias="from", description="tag.corner")
    to: str
    u95_um: Positive


class RequirementsTable(Table):
    """[requirements]: design to a tolerance."""

    max_sigma_um: Positive | None = None
    distances: tuple[DistanceRequirement, ...] = ()
    max_images: Annotated[int, Field(ge=2)] | None = None
    max_tour: Positive | None = Field(None, description="in the unit of f2: mm, rad or s")


class SearchTable(Table):
    """[search]: the engine and its budget, counted in evaluations, never in seconds."""

    engine: Literal["memetic", "nsga2"] = Field("memetic", description="nsga2: the source paper's operators")
    population: Annotated[int, Field(ge=4, le=10000)] = 200
    generations: Annotated[int, Field(ge=1)] = 300
    max_networks: Annotated[int, Field(ge=1)] = Field(40, description="networks of the front that are kept")


class ValidationTable(Table):
    """[validation]: how every network of the front is proved."""

    datum: Literal["free"] = "free"
    repeats: Annotated[int, Field(ge=1)] = 1
    supersample: Annotated[int, Field(ge=1, le=8)] = 4
    pose_jitter_mm: NotNegative = Field(1.0, description="robot pose error of the images: position, per axis")
    pose_jitter_mrad: NotNegative = Field(5.0, description="robot pose error of the images: rotation, per axis")


class Study(Table):
    """A whole study file."""

    format: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    seed: Annotated[int, Field(ge=0)] = 1
    part: PartTable
    targets: TargetsTable
    camera: CameraTable
    viewpoints: ViewpointsTable
    visibility: VisibilityTable = VisibilityTable()
    robot: RobotTable | None = None
    objectives: ObjectivesTable = ObjectivesTable()
    requirements: RequirementsTable = RequirementsTable()
    search: SearchTable = SearchTable()
    validation: ValidationTable = ValidationTable()

    @model_validator(mode="after")
    def _motion_needs_a_robot(self) -> "Study":
        if self.robot is None and self.objectives.motion in ("joint", "time"):
            raise ValueError(f"objectives.motion: {self.objectives.motion} needs a [robot] table")
        return self

    @property
    def motion(self) -> Literal["workspace", "joint", "time"]:
        """The motion objective, its default resolved."""
        return self.objectives.motion or ("workspace" if self.robot is None else "joint")
