"""An image set, photographs of a tagged part, made into an observation set.

The folder holds

    camera.toml         [camera] as in a study; optional [targets] with family and size_mm (edge of the black squares)
    images/*.png …      the photographs, or beside camera.toml
    targets.csv         nominal tags as in a study (tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz), or
    tags.csv            tag,size_mm, when nothing is known of the part; or nothing: every tag of the family counts

With targets.csv the nominal coordinates are the approximate values and the world frame. Without, the world is the frame
of the tag seen most often, and the mean edge of the tags gives the scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.initial import TagSighting, poses_and_tags, poses_on_known_tags, square
from netdesign.adjustment.problem import BundleProblem
from netdesign.adjustment.solver import solve
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.observations import ObservationSet, csv_rows
from netdesign.files.parts import TAG_COUNT, load_targets
from netdesign.files.study_text import first_problem, read_toml
from netdesign.imageset import measure_images
from netdesign.imaging.detect import pose_from_tag
from netdesign.imaging.measure import Gates, TagMeasurement
from netdesign.model.adjustment import ControlPoints
from netdesign.model.arrays import Bools, Floats
from netdesign.model.camera import Camera
from netdesign.model.frames import pose, transform
from netdesign.model.network import Observations
from netdesign.model.progress import Progress
from netdesign.model.scene import CORNERS_PER_TAG, Targets
from netdesign.model.study import CameraTable
from netdesign.photogrammetry.connectivity import listed, named

SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}
MM = 1e-3
LOOSE_CHI2 = 1e6  # with a sigma given by the user the photometric misfit of a tag is not judged


@dataclass(frozen=True, kw_only=True)
class PhotoSet:
    """An image set as an observation set, with what was left out.

    Attributes:
        notes: images without tags, tags that were not believed.
    """

    observations: ObservationSet
    notes: tuple[str, ...]


def is_photo_set(folder: Path) -> bool:
    """Tell whether the folder has a camera.toml and photographs, and is no observation set with measured points."""
    return (folder / "camera.toml").is_file() and not (folder / "observations.csv").is_file() and bool(_photos(folder))


def _photos(folder: Path) -> list[Path]:
    place = folder / "images" if (folder / "images").is_dir() else folder
    return sorted(path for path in place.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


def read_photo_set(folder: Path, sigma_px: float | None, progress: Progress) -> PhotoSet:
    """Measure the photographs and find approximate values.

    Args:
        sigma_px: noise of an image coordinate instead of the measured covariances; the pictures then need not follow
            the camera's sensor model.

    Raises:
        InputError: camera.toml, targets.csv or tags.csv is wrong.
        InfeasibleError: too few tags are found, or nothing ties the images together.
    """
    photos = _photos(folder)
    camera, targets, known = _camera_and_targets(folder)
    gates = None if sigma_px is None else Gates(chi2_base=LOOSE_CHI2)
    measured = measure_images(photos, camera, targets, gates=gates, progress=progress)
    good = [[tag for tag in tags if not tag.rejected] for tags in measured]
    refused = [tag.rejected for tags in measured for tag in tags if tag.rejected]
    seen = np.array([len(tags) > 0 for tags in good])
    names = tuple(path.name for path in photos)
    if seen.sum() < 2:
        raise InfeasibleError(
            f"{folder}: expected tags in at least 2 photographs, found them in {int(seen.sum())} of {len(photos)}; "
            f"{len(refused)} tag(s) were refused{': ' + refused[0] if refused else ''}"
        )
    notes = []
    if not seen.all():
        notes.append(
            f"{int((~seen).sum())} photograph(s) show no usable tag and are left out: {listed(named(names, ~seen))}"
        )
    if refused:
        notes.append(f"{len(refused)} tag image(s) were not believed, the first because: {refused[0]}")
    kept_names = tuple(named(names, seen))
    kept = [tags for tags in good if tags]
    found = _on_nominal(kept, kept_names, camera, targets, sigma_px) if known else None
    return PhotoSet(
        observations=found or _on_tags_alone(kept, kept_names, camera, targets, sigma_px), notes=tuple(notes)
    )


def _camera_and_targets(folder: Path) -> tuple[Camera, Targets, bool]:
    """Return the camera, the tags that may occur, and whether their nominal places are known."""
    path = folder / "camera.toml"
    content = read_toml(path)
    try:
        table = CameraTable.model_validate(content.get("camera", content))
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error, CameraTable)}") from None
    camera = Camera(
        width_px=table.width_px,
        height_px=table.height_px,
        focal_px=np.array(table.focal_px),
        principal_point_px=np.array(table.principal_point_px),
        distortion=np.array(table.distortion),
        sigma_px=table.sigma_px,
        blur_px=table.blur_px,
        full_well_e=table.full_well_e,
        read_noise_e=table.read_noise_e,
    )
    tags = content.get("targets", {}) if "camera" in content else {}
    family = tags.get("family", "tag36h11")
    if family not in TAG_COUNT:
        raise InputError(f"{path}: targets.family: expected one of {', '.join(TAG_COUNT)}, found {family!r}")
    size, ids = tags.get("size_mm"), np.arange(TAG_COUNT[family])
    if (folder / "tags.csv").is_file():
        ids, size = _tag_list(folder / "tags.csv")
    if not (isinstance(size, int | float) and size > 0):
        raise InputError(
            f"{path}: expected targets.size_mm (edge of the tags) or a tags.csv with tag,size_mm, found none"
        )
    if (folder / "targets.csv").is_file():
        return camera, load_targets(folder / "targets.csv", family, float(size) * MM, np.eye(4)), True
    count = len(ids)
    anywhere = Targets(
        ids=ids,
        centres=np.zeros((count, 3)),
        normals=np.tile([0.0, 0, 1], (count, 1)),
        x_axes=np.tile([1.0, 0, 0], (count, 1)),
        size_m=float(size) * MM,
        family=family,
    )
    return camera, anywhere, False


def _tag_list(path: Path) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], float]:
    """Return tag ids and their one size in mm of tags.csv."""
    ids, sizes = [], set()
    for where, row in csv_rows(path, ("tag", "size_mm")):
        try:
            tag, size = int(row["tag"]), float(row["size_mm"])
        except ValueError:
            raise InputError(f"{where}: expected a tag id and a size, found {list(row.values())}") from None
        if tag < 0 or tag in ids or not (np.isfinite(size) and size > 0):
            raise InputError(f"{where}: expected a new tag id and a positive size, found {tag}, {size}")
        ids.append(tag)
        sizes.add(size)
    if len(sizes) != 1:
        raise InputError(f"{path}: expected tags of one size, found {sorted(sizes)}")
    return np.array(ids, dtype=np.int64), sizes.pop()


def _sightings(measured: Sequence[Sequence[TagMeasurement]], camera: Camera, targets: Targets) -> list[TagSighting]:
    row = {tag: index for index, tag in enumerate(targets.ids.tolist())}
    return [
        TagSighting(
            image=image,
            tag=row[tag.tag_id],
            corners_px=tag.corners_px,
            candidates=tuple(pose_from_tag(tag.corners_px, targets.size_m, camera.intrinsics)),
        )
        for image, tags in enumerate(measured)
        for tag in tags
    ]


def _observations(
    measured: Sequence[Sequence[TagMeasurement]], targets: Targets, sigma_px: float | None
) -> Observations:
    row = {tag: index for index, tag in enumerate(targets.ids.tolist())}
    image, point, xy, covariance = [], [], [], []
    for index, tags in enumerate(measured):
        for tag in tags:
            for corner in range(CORNERS_PER_TAG):
                image.append(index)
                point.append(CORNERS_PER_TAG * row[tag.tag_id] + corner)
                xy.append(tag.corners_px[corner])
                block = tag.covariance_px2[2 * corner : 2 * corner + 2, 2 * corner : 2 * corner + 2]
                covariance.append(block if sigma_px is None else sigma_px**2 * np.eye(2))
    return Observations(
        image=np.array(image), point=np.array(point), xy_px=np.array(xy), covariance=np.array(covariance)
    )


def _set(
    names: tuple[str, ...], targets: Targets, camera: Camera, poses: Floats, points: Floats, observations: Observations
) -> ObservationSet:
    return ObservationSet(
        image_names=names,
        point_names=targets.point_ids,
        intrinsics=camera.intrinsics[None, :],
        camera_of_image=np.zeros(len(names), dtype=np.int64),
        world_from_cam=poses,
        points=points,
        observations=observations,
        sigma_known=True,
    )


def _on_nominal(
    measured: Sequence[Sequence[TagMeasurement]],
    names: tuple[str, ...],
    camera: Camera,
    targets: Targets,
    sigma_px: float | None,
) -> ObservationSet:
    """Return the set with poses from resection on the nominal coordinates."""
    up = np.cross(targets.normals, targets.x_axes)
    world_from_tag = pose(np.stack([targets.x_axes, up, targets.normals], axis=2), targets.centres)
    poses, _ = poses_on_known_tags(
        _sightings(measured, camera, targets), world_from_tag, targets.size_m, camera.intrinsics, len(names)
    )
    found = _set(names, targets, camera, poses, targets.points, _observations(measured, targets, sigma_px))
    # One tag's pose is good to some ten millimetres; a robust resection on all of them to the nominal accuracy.
    count = len(targets.points)
    nominal = ControlPoints(point=np.arange(count), xyz=targets.points, sigma=np.zeros(count))
    resection = replace(_problem(found), datum="fixed", control=nominal)
    return replace(found, world_from_cam=solve(resection, robust=True).problem.world_from_cam)


def _on_tags_alone(
    measured: Sequence[Sequence[TagMeasurement]],
    names: tuple[str, ...],
    camera: Camera,
    targets: Targets,
    sigma_px: float | None,
) -> ObservationSet:
    """Return the set with everything from the tags: poses, points, and the scale from their mean edge."""
    ids = sorted({tag.tag_id for tags in measured for tag in tags})
    rows = np.searchsorted(np.sort(targets.ids), ids)
    order = np.argsort(targets.ids)[rows]
    seen = Targets(
        ids=targets.ids[order],
        centres=targets.centres[order],
        normals=targets.normals[order],
        x_axes=targets.x_axes[order],
        size_m=targets.size_m,
        family=targets.family,
    )
    poses, world_from_tag = poses_and_tags(
        _sightings(measured, camera, seen), seen.size_m, camera.intrinsics, names, [str(tag) for tag in ids]
    )
    points = transform(world_from_tag[:, None], square(seen.size_m)[None]).reshape(-1, 3)
    observations = _observations(measured, seen, sigma_px)
    once = np.bincount(observations.point, minlength=len(points)) < 2
    if once.any():
        # A tag that one image sees has known size but no second ray: it cannot be adjusted point by point.
        observations = observations.select(~once[observations.point])
    found = _set(names, seen, camera, poses, points, observations)
    adjusted = estimate(_problem(found), robust=True)
    points = np.where(adjusted.used[:, None], adjusted.points, points)
    scale = seen.size_m / _mean_edge(points, adjusted.used)
    poses = adjusted.world_from_cam.copy()
    poses[:, :3, 3] *= scale
    return replace(found, world_from_cam=poses, points=points * scale)


def _mean_edge(points: Floats, used: Bools) -> float:
    """Return the mean edge of the tags whose four corners have an estimate."""
    corners = points.reshape(-1, CORNERS_PER_TAG, 3)[used.reshape(-1, CORNERS_PER_TAG).all(axis=1)]
    return float(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).mean())


def _problem(found: ObservationSet) -> BundleProblem:
    return BundleProblem(
        observations=found.observations,
        camera_of_image=found.camera_of_image,
        intrinsics=found.intrinsics,
        world_from_cam=found.world_from_cam,
        points=found.points,
        image_names=found.image_names,
        point_names=found.point_names,
    )
