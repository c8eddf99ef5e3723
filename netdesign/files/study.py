"""From a study file to a Task, and to a folder from which the same study runs anywhere.

``resolve`` collects the study with every default spelled out and the bytes of every input; ``write_resolved`` puts them
into a run directory (study.toml, inputs/); ``load_task`` turns a study file into SI values with meshes loaded.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InfeasibleError, InputError
from netdesign.files.noise import read_corner_noise
from netdesign.files.packages import resolve_path
from netdesign.files.parts import load_part, load_targets, spread_targets
from netdesign.files.robot import bundle_robot, resolve_cell
from netdesign.files.stations import parse_stations, stations_table
from netdesign.files.store import write_bytes, write_text
from netdesign.files.study_text import parse_study, read_toml, study_toml
from netdesign.model.arrays import Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.frames import pose, rotation_from_rpy
from netdesign.model.scene import Part, Scene, Targets
from netdesign.model.stations import Depth, ViewingSphere
from netdesign.model.study import CameraTable, PartTable, Study, ViewpointsTable, VisibilityTable
from netdesign.model.task import Task, VisibilityLimits
from netdesign.photogrammetry.connectivity import listed
from netdesign.photogrammetry.seating import overlapping
from netdesign.photogrammetry.visibility import seen_share

MM = 1e-3


@dataclass(frozen=True, kw_only=True)
class ResolvedStudy:
    """A study that needs nothing outside: ``inputs`` maps paths below the run directory to file contents."""

    study: Study
    inputs: dict[str, bytes]

    @property
    def text(self) -> str:
        """The study as TOML, every default spelled out, paths into inputs/."""
        return study_toml(self.study)

    @property
    def sha256(self) -> str:
        """Hash of the text and of every input: the same study, the same hash, wherever it lies."""
        digest = hashlib.sha256(self.text.encode())
        for name, content in sorted(self.inputs.items()):
            digest.update(f"\n{name} {hashlib.sha256(content).hexdigest()}".encode())
        return digest.hexdigest()


def read_study(path: Path) -> Study:
    """Read and check a study file; a camera kept in a file of its own is read in.

    Raises:
        InputError: with file, table, key, what was expected and what was found.
    """
    content = read_toml(path)
    camera = content.get("camera")
    if isinstance(camera, dict) and "file" in camera:
        file = _beside(path, camera["file"])
        table = read_toml(file)
        own = {key: value for key, value in camera.items() if key != "file"}
        content = {**content, "camera": {**table.get("camera", table), **own}}
    return parse_study(content, path)


def resolve(path: Path, seed: int | None = None) -> ResolvedStudy:
    """Read a study and everything it points to.

    Raises:
        InputError: an input is missing or wrong.
    """
    study = read_study(path)
    inputs: dict[str, bytes] = {}

    def take(file: str, name: str) -> str:
        source = _beside(path, file)
        if source.is_dir():
            raise InputError(f"{source}: expected a file, found a folder, named in {path}")
        if not source.is_file():
            raise InputError(f"{source}: no such file, named in {path}")
        inputs[name] = source.read_bytes()
        return name

    part = study.part.model_copy(
        update={"mesh": take(study.part.mesh, "inputs/part" + Path(study.part.mesh).suffix.lower())}
    )
    targets = study.targets
    if targets.file is not None:
        targets = targets.model_copy(update={"file": take(targets.file, "inputs/targets.csv")})
    camera = study.camera
    if camera.noise_file is not None:
        camera = camera.model_copy(update={"noise_file": take(camera.noise_file, "inputs/noise.json")})
    viewpoints = study.viewpoints
    if viewpoints.existing is not None:
        inputs["inputs/existing.csv"] = stations_table(viewpoints.existing, path.parent)
        viewpoints = viewpoints.model_copy(update={"existing": "inputs/existing.csv"})
    robot = study.robot
    if robot is not None:
        robot, files = bundle_robot(robot, path.parent)
        inputs.update(files)
    resolved = study.model_copy(
        update={
            "part": part,
            "targets": targets,
            "camera": camera,
            "viewpoints": viewpoints,
            "robot": robot,
            "seed": study.seed if seed is None else seed,
            "objectives": study.objectives.model_copy(update={"motion": study.motion}),
        }
    )
    return ResolvedStudy(study=resolved, inputs=inputs)


def write_resolved(resolved: ResolvedStudy, run: Path) -> Path:
    """Write inputs/ and study.toml below ``run`` and return the path of study.toml, written last."""
    for name, content in resolved.inputs.items():
        write_bytes(run / name, content)
    write_text(run / "study.toml", resolved.text)
    return run / "study.toml"


def load_task(path: Path, seed: int | None = None) -> Task:
    """Return the study at ``path`` in SI values, meshes loaded and placed.

    Raises:
        InputError: an input is missing or wrong, or the viewing sphere does not clear the part.
    """
    resolved = resolve(path, seed)
    study = read_study(path)
    part_table = study.part
    world_from_mesh = pose(
        rotation_from_rpy(np.radians(part_table.rotation_deg)), np.array(part_table.position_mm) * MM
    )
    part = load_part(_beside(path, part_table.mesh), part_table.unit, world_from_mesh)
    sphere = _sphere(study.viewpoints)
    _check_clearance(part, sphere, part_table, path)  # before tags are spread over a part in the wrong unit
    scene = Scene(part=part, targets=_targets(study, path, part, world_from_mesh))
    camera, limits = camera_of_table(study.camera, path, study.targets.family), _limits(study.visibility)
    scene, left_out = _worth_measuring(study, path, scene, camera, sphere, limits)
    return Task(
        study=resolved.study,
        scene=scene,
        left_out=left_out,
        camera=camera,
        sphere=sphere,
        limits=limits,
        cell=None if study.robot is None else resolve_cell(study.robot, path.parent),
        sha256=resolved.sha256,
        existing=_existing(resolved),
    )


def _beside(path: Path, name: Any) -> Path:
    """Return the file that the study at ``path`` names: beside it, absolute, or inside an installed package."""
    return resolve_path(str(name), path.parent)


def _existing(resolved: ResolvedStudy) -> Floats:
    content = resolved.inputs.get("inputs/existing.csv")
    if content is None:
        return np.zeros((0, 4, 4))
    return parse_stations(content, Path("existing.csv"))


def _targets(study: Study, path: Path, part: Part, world_from_mesh: Floats) -> Targets:
    table = study.targets
    size = table.size_mm * MM
    if table.file is not None:
        targets = load_targets(_beside(path, table.file), table.family, size, world_from_mesh)
        shared = overlapping(targets)
        if shared:
            raise InputError(
                f"{_beside(path, table.file)}: expected tags of {table.size_mm:g} mm beside each other, found "
                f"{len(shared)} pair(s) that overlap (x_mm, y_mm, z_mm are millimetres): "
                f"{listed([f'{one} and {other}' for one, other in shared])}"
            )
        return targets
    assert table.spacing_mm is not None  # the table has exactly one of the two
    return spread_targets(part, table.family, size, table.spacing_mm * MM)


def _worth_measuring(
    study: Study, path: Path, scene: Scene, camera: Camera, sphere: ViewingSphere, limits: VisibilityLimits
) -> tuple[Scene, tuple[int, ...]]:
    """Return the scene without the tags that too little of the sphere sees, and their ids."""
    least = study.targets.min_seen_share
    if least == 0:
        return scene, ()
    kept = seen_share(scene, camera, sphere, limits) >= least
    if not kept.any():
        raise InfeasibleError(
            f"{path}: targets.min_seen_share: none of the {len(kept)} tags is seen from {least:.1%} of the sphere; "
            "without this key `netdesign check` counts what refuses them"
        )
    ids: Ints = scene.targets.ids[~kept]
    return replace(scene, targets=scene.targets.take(kept)), tuple(ids.tolist())


def camera_of_table(table: CameraTable, path: Path, family: str) -> Camera:
    """Return the camera of a [camera] table in the file ``path``, with the noise of a family of tags."""
    noise = None
    if table.noise == "detector":
        noise = read_corner_noise(None if table.noise_file is None else _beside(path, table.noise_file), family)
    return Camera(
        width_px=table.width_px,
        height_px=table.height_px,
        focal_px=np.array(table.focal_px),
        principal_point_px=np.array(table.principal_point_px),
        distortion=np.array(table.distortion),
        pixel_m=None if table.pixel_um is None else table.pixel_um * 1e-6,
        f_number=table.f_number,
        focus_m=None if table.focus_mm is None else table.focus_mm * MM,
        dof_blur_px=table.dof_blur_px,
        sigma_px=table.sigma_px,
        corner_noise=noise,
        blur_px=table.blur_px,
        full_well_e=table.full_well_e,
        read_noise_e=table.read_noise_e,
    )


def _sphere(table: ViewpointsTable) -> ViewingSphere:
    azimuth, elevation = np.radians(table.azimuth_deg), np.radians(table.elevation_deg)
    centre, depth = np.array(table.centre_mm) * MM, None
    low, high = (np.array(values) * MM for values in table.extent_mm)
    if table.box_mm is not None:
        depth = Depth(shape="box", low=low - centre, high=high - centre)
        farthest = float(np.linalg.norm(np.maximum(np.abs(depth.low), np.abs(depth.high))))
    else:
        farthest = float(high.max())
        if isinstance(table.radius_mm, tuple) or table.semi_axes_mm is not None:
            depth = Depth(shape="ellipsoid", low=low, high=high)
    return ViewingSphere(
        centre=centre,
        radius=farthest,
        depth=depth,
        azimuth=(float(azimuth[0]), float(azimuth[1])),
        elevation=(float(elevation[0]), float(elevation[1])),
        roll=None if table.roll_deg == "free" else float(np.radians(table.roll_deg)),
        max_images=table.max_images,
    )


def _limits(table: VisibilityTable) -> VisibilityLimits:
    return VisibilityLimits(
        max_incidence=float(np.radians(table.max_incidence_deg)),
        min_tag_px=table.min_tag_px,
        border_px=table.border_px,
        min_rays=table.min_rays,
        min_points_per_image=table.min_points_per_image,
        occlusion=table.occlusion,
    )


def _check_clearance(part: Part, sphere: ViewingSphere, table: PartTable, path: Path) -> None:
    """Raise InputError when the part reaches the nearest stations: mostly a mesh in another unit."""
    offset = part.vertices - sphere.centre
    reach = float(np.linalg.norm(offset, axis=1).max())
    unit = f"(part.unit is {table.unit})"
    if sphere.depth is None:
        if reach >= sphere.radius:
            raise InputError(
                f"{path}: viewpoints.radius_mm: expected more than the part's reach of {reach / MM:.1f} mm from the "
                f"centre {unit}, found {sphere.radius / MM:g}"
            )
        return
    if sphere.depth.shape == "ellipsoid":
        inside = np.linalg.norm(offset / sphere.depth.low, axis=1).max() < 1.0
    else:
        inside = reach < sphere.radius
    if not inside:
        raise InputError(
            f"{path}: viewpoints: expected stations outside of the part, which reaches {reach / MM:.1f} mm from the "
            f"centre {unit}, found stations within it"
        )
    viewpoints, _ = sphere.sample(np.radians(2.0))
    if not len(viewpoints):
        raise InputError(
            f"{path}: viewpoints.box_mm: expected a box that directions from centre_mm within elevation_deg and"
            " azimuth_deg meet, found none that does"
        )
