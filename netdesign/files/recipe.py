"""Recipes of free-standing image sets: a study's part, tags and camera, poses at random or given, light and faults."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from netdesign.errors import InputError
from netdesign.files.study import camera_of_table, load_task
from netdesign.files.study_text import first_problem, read_toml
from netdesign.imaging.looks import Appearance
from netdesign.imaging.optics import Shading
from netdesign.imaging.photograph import RendererName, Shoot
from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.frames import look_at, pose, rotation_from_rpy, sphere_directions
from netdesign.model.scene import FAMILIES, Part, Scene, Targets
from netdesign.model.study import CameraTable, NotNegative, Number, Range, Table, Vector3
from netdesign.model.task import VisibilityLimits

MM = 1e-3
POSE_COLUMNS = 6
Level = Annotated[float, Field(ge=0, le=1)]
LENS_SAMPLES = 32
WAVELENGTH_M = 550e-9
WRONG_EVERY = 4  # pictures, one shows exchanged ids, another pair each time
AIRY_SIGMA = 0.42  # sigma of the Gaussian nearest to an Airy disk, in wavelength x f-number


class PosesTable(Table):
    """[poses]: stations drawn evenly from these ranges, or given."""

    images: Annotated[int, Field(ge=1)] = 12
    centre_mm: Vector3 = (0, 0, 0)
    distance_mm: Range = (450, 700)
    azimuth_deg: Range = (-180, 180)
    elevation_deg: Range = (25, 85)
    roll_deg: Range = (-180, 180)
    aim_mm: NotNegative = Field(10, description="spread of the point looked at, per axis")
    given: tuple[tuple[Number, Number, Number, Number, Number, Number], ...] = Field(
        (), description="instead: x, y, z in mm and roll, pitch, yaw in deg (URDF order) of world_from_cam, per image"
    )

    @model_validator(mode="after")
    def _ordered(self) -> "PosesTable":
        for name, least, largest in (
            ("distance_mm", 1e-3, 1e9), ("azimuth_deg", -360, 360), ("elevation_deg", -90, 90), ("roll_deg", -360, 360)
        ):  # fmt: skip
            low, high = getattr(self, name)
            if not least <= low <= high <= largest:
                raise ValueError(
                    f"{name}: expected low <= high from {least:g} to {largest:g}, found [{low:g}, {high:g}]"
                )
        return self


class LightTable(Table):
    """[light]: linear levels, full scale 1."""

    black: Level = Appearance.black
    white: Level = Appearance.white
    face: Level = Appearance.face
    relief: NotNegative = Appearance.relief
    mottle: NotNegative = Field(0.0, description="random level of every face of the part, plus or minus")
    background: Level = Appearance.background
    vignetting: NotNegative = Field(0.0, description="exponent of the cosine law")
    gradient: tuple[Number, Number] = Field((0, 0), description="relative change across and down the picture")


class ExposureTable(Table):
    """[exposure]: how the picture is taken."""

    supersample: Annotated[int, Field(ge=1, le=8)] = 4
    bits: Literal[8, 16] = 8
    noise: bool = True
    depth_of_field: bool = Field(False, description="blur by distance; needs pixel_um, f_number, focus_mm")
    diffraction: bool = Field(False, description="adds the Airy disk of the f-number to blur_px")
    motion_mm: Vector3 = Field((0, 0, 0), description="way of the camera during the exposure, camera axes")


class FaultsTable(Table):
    """[faults]: what goes wrong on purpose; the truth does not know of it."""

    wrong_ids: Annotated[int, Field(ge=0)] = Field(
        0, description="pairs of tags that exchange their ids, in some pictures"
    )
    glare: Annotated[int, Field(ge=0)] = Field(0, description="spots of stray light per picture")
    clutter: Annotated[int, Field(ge=0)] = Field(0, description="boxes around the part, with foreign tags on top")


class ExtrasTable(Table):
    """[extras]: files beside the images."""

    depth: bool = Field(False, description="depth/*.npy, float32 m")
    tag_mask: bool = Field(False, description="masks/*.png, 16 bit, id + 1")
    kalibr: bool = Field(False, description="camchain.yaml and, for a flat grid, aprilgrid.yaml")
    opencv: bool = Field(False, description="camera-opencv.yaml")


class Recipe(Table):
    """A whole recipe."""

    format: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    about: str = Field("", description="one sentence for the set's README")
    study: str = Field(description="the study whose part, targets, camera and visibility are used")
    seed: Annotated[int, Field(ge=0)] = 1
    camera: dict[str, Any] = Field(default_factory=dict, description="keys of [camera] that differ from the study")
    poses: PosesTable = PosesTable()
    light: LightTable = LightTable()
    exposure: ExposureTable = ExposureTable()
    faults: FaultsTable = FaultsTable()
    extras: ExtrasTable = ExtrasTable()


@dataclass(frozen=True, kw_only=True)
class ImageSetPlan:
    """A recipe in SI values.

    Attributes:
        scene: what is claimed; drawn: what stands before the camera, faults included, per image.
        world_from_cam: (n, 4, 4) m.
    """

    recipe: Recipe
    scene: Scene
    drawn: tuple[Scene, ...]
    camera: Camera
    limits: VisibilityLimits
    world_from_cam: Floats
    shoot: Shoot


def load_recipe(path: Path, renderer: RendererName = "pyrender") -> ImageSetPlan:
    """Read a recipe and everything it points to.

    Raises:
        InputError: with file, table, key, what was expected and what was found.
    """
    try:
        recipe = Recipe.model_validate(read_toml(path))
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error, Recipe)}") from None
    task = load_task(path.parent / recipe.study)
    table = task.study.camera.model_dump() | recipe.camera
    try:
        camera = camera_of_table(CameraTable.model_validate(table), path, task.scene.targets.family)
    except ValidationError as error:
        raise InputError(f"{path}: camera.{first_problem(error, CameraTable)}") from None
    if recipe.exposure.depth_of_field or recipe.exposure.diffraction:
        camera = _with_optics(camera, recipe, path)
    light, exposure = recipe.light, recipe.exposure
    shoot = Shoot(
        seed=recipe.seed, supersample=exposure.supersample, renderer=renderer, bits=exposure.bits,
        noise=exposure.noise, lens_samples=LENS_SAMPLES if exposure.depth_of_field else 0, glare=recipe.faults.glare,
        motion_m=(exposure.motion_mm[0] * MM, exposure.motion_mm[1] * MM, exposure.motion_mm[2] * MM),
        shading=Shading(vignetting=light.vignetting, gradient=light.gradient),
        appearance=Appearance(
            black=light.black, white=light.white, face=light.face, relief=light.relief, mottle=light.mottle,
            background=light.background,
        ),
    )  # fmt: skip
    random = np.random.default_rng([recipe.seed, 2])
    stations = _stations(recipe.poses, np.random.default_rng([recipe.seed, 3]))
    solid, drawn = _with_faults(task.scene, recipe.faults, len(stations), random)
    return ImageSetPlan(
        recipe=recipe, scene=solid, drawn=drawn, camera=camera, limits=task.limits,
        world_from_cam=stations, shoot=shoot,
    )  # fmt: skip


def _with_optics(camera: Camera, recipe: Recipe, path: Path) -> Camera:
    if camera.pixel_m is None or camera.f_number is None or camera.focus_m is None:
        raise InputError(f"{path}: exposure: depth_of_field and diffraction need camera.pixel_um, f_number, focus_mm")
    if not recipe.exposure.diffraction:
        return camera
    airy_px = AIRY_SIGMA * WAVELENGTH_M * camera.f_number / camera.pixel_m
    return replace(camera, blur_px=float(np.hypot(camera.blur_px, airy_px)))


def _stations(table: PosesTable, random: np.random.Generator) -> Floats:
    """Return world_from_cam (n, 4, 4) m."""
    if table.given:
        given = np.array(table.given)
        turns = np.array([rotation_from_rpy(np.radians(row[3:])) for row in given])
        return pose(turns, given[:, :3] * MM)
    count = table.images
    viewpoints = np.column_stack(
        [np.radians(random.uniform(*table.azimuth_deg, count)), np.radians(random.uniform(*table.elevation_deg, count))]
    )
    aim = np.array(table.centre_mm) * MM + random.normal(scale=table.aim_mm * MM, size=(count, 3))
    distance = random.uniform(*table.distance_mm, count) * MM
    roll = np.radians(random.uniform(*table.roll_deg, count))
    return look_at(aim + distance[:, None] * sphere_directions(viewpoints), aim, roll)


def _with_faults(
    scene: Scene, faults: FaultsTable, images: int, random: np.random.Generator
) -> tuple[Scene, tuple[Scene, ...]]:
    """Return the scene as claimed, with clutter that may hide tags, and per image the scene as drawn."""
    part, targets = scene.part, scene.targets
    foreign = np.setdiff1d(np.arange(FAMILIES[targets.family].ids), targets.ids)[: faults.clutter]
    centres, heights = [], []
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    reach = float(np.linalg.norm(high - low)) / 2
    vertices, faces = [part.vertices], [part.faces]
    for _ in range(faults.clutter):
        size = targets.size_m * random.uniform(1.5, 2.5, 3)
        angle, away = random.uniform(-np.pi, np.pi), reach * random.uniform(1.1, 1.8)
        centre = np.array([away * np.cos(angle), away * np.sin(angle), low[2] + size[2] / 2])
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size + centre
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces.append(
            np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]) + sum(len(item) for item in vertices)
        )
        vertices.append(corners)
        centres.append(centre)
        heights.append(size[2] / 2)
    solid = Part(vertices=np.concatenate(vertices), faces=np.concatenate(faces))
    drawn = targets
    if len(foreign):
        tops = np.array(centres)[: len(foreign)] + np.array(heights)[: len(foreign), None] * np.array([0, 0, 1.0])
        drawn = Targets(
            ids=np.concatenate([targets.ids, foreign]), centres=np.concatenate([targets.centres, tops]),
            normals=np.concatenate([targets.normals, np.tile([0.0, 0, 1], (len(foreign), 1))]),
            x_axes=np.concatenate([targets.x_axes, np.tile([1.0, 0, 0], (len(foreign), 1))]),
            size_m=targets.size_m, family=targets.family,
        )  # fmt: skip
    shown = [Scene(part=solid, targets=drawn)] * images
    # In every picture alike they would be no outliers but two tags, each well measured at the other's place.
    for image in random.permutation(images)[: -(-images // WRONG_EVERY)] if faults.wrong_ids else ():
        ids = drawn.ids.copy()
        chosen = random.permutation(len(targets.ids))[: 2 * faults.wrong_ids]
        ids[chosen] = ids[chosen[::-1]]
        shown[image] = Scene(part=solid, targets=replace(drawn, ids=ids))
    return Scene(part=solid, targets=targets), tuple(shown)
