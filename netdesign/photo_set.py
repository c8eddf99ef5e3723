"""An image set, photographs of a tagged part, made into an observation set.

What the folder holds is told in ``files/photo_folder.py``. With targets.csv the nominal coordinates are the approximate
values and the world frame. Without, the world is the frame of the tag seen most often, and the mean edge of the tags
gives the scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.initial import TagSighting, poses_and_tags, poses_on_known_tags, square
from netdesign.adjustment.solver import solve
from netdesign.errors import InfeasibleError
from netdesign.files.observations import ObservationSet
from netdesign.files.photo_folder import photos_in, read_camera_and_targets, read_gamma
from netdesign.imageset import measure_images
from netdesign.imaging.detect import pose_from_tag
from netdesign.imaging.measure import Gates, TagMeasurement
from netdesign.imaging.pictures import read_picture
from netdesign.imaging.tone import Tone, estimate_tone
from netdesign.model.adjustment import ControlPoints
from netdesign.model.arrays import Bools, Floats
from netdesign.model.camera import Camera
from netdesign.model.frames import pose, transform
from netdesign.model.network import Observations
from netdesign.model.progress import Progress
from netdesign.model.scene import CORNERS_PER_TAG, Targets
from netdesign.photogrammetry.connectivity import listed, named

LEAST_CONTRAST = 0.01  # of full scale; 12 bits stored in 16 use a sixteenth of it
DOUBTFUL_BOW = 0.05  # 0.02 px
SAMPLES = 4  # photographs that tell the tone curve and the noise


@dataclass(frozen=True, kw_only=True)
class PhotoSet:
    """An image set as an observation set, with what was left out.

    Attributes:
        notes: images without tags, tags that were not believed.
        on_nominal: the points are nominal coordinates, from targets.csv.
    """

    observations: ObservationSet
    notes: tuple[str, ...]
    on_nominal: bool


def is_photo_set(folder: Path) -> bool:
    """Tell whether the folder has a camera.toml and photographs, and is no observation set with measured points."""
    return (
        (folder / "camera.toml").is_file() and not (folder / "observations.csv").is_file() and bool(photos_in(folder))
    )


def read_photo_set(folder: Path, sigma_px: float | None, progress: Progress, refine: tuple[str, ...] = ()) -> PhotoSet:
    """Measure the photographs and find approximate values.

    Args:
        sigma_px: noise of an image coordinate instead of the measured covariances.
        refine: interior parameters that are not known well; free already where the scale is found.

    Raises:
        InputError: camera.toml, targets.csv or tags.csv is wrong.
        InfeasibleError: too few tags are found, or nothing ties the images together.
    """
    photos = photos_in(folder)
    camera, targets, known = read_camera_and_targets(folder)
    stated = read_gamma(folder)
    tone = _tone(photos, camera, targets, stated)
    # The sensor behind a photograph is rarely the one that camera.toml describes: each picture tells its own noise.
    gates = Gates(own_noise=True, noise_scale=tone.noise, min_contrast=LEAST_CONTRAST)
    measured = measure_images(photos, camera, targets, gates=gates, gamma=tone.gamma, progress=progress)
    good = [[tag for tag in tags if not tag.rejected] for tags in measured]
    refused = [tag.rejected for tags in measured for tag in tags if tag.rejected]
    seen = np.array([len(tags) > 0 for tags in good])
    names = tuple(path.name for path in photos)
    if seen.sum() < 2:
        raise InfeasibleError(
            f"{folder}: expected tags of {targets.family} in at least 2 photographs, found them in {int(seen.sum())} of"
            f" {len(photos)}; {len(refused)} tag(s) were refused{': ' + refused[0] if refused else ''}"
        )
    notes = _tone_notes(tone, stated)
    if not seen.all():
        notes.append(
            f"{int((~seen).sum())} photograph(s) show no usable tag and are left out: {listed(named(names, ~seen))}"
        )
    if refused:
        notes.append(f"{len(refused)} tag image(s) were not believed, the first because: {refused[0]}")
    kept_names = tuple(named(names, seen))
    kept = [tags for tags in good if tags]
    if known:
        found, left_out = _tied(_on_nominal(kept, kept_names, camera, targets, sigma_px))
    else:
        found, left_out = _tied(_on_tags_alone(kept, kept_names, camera, targets, sigma_px, refine))
    return PhotoSet(observations=found, notes=(*notes, *left_out), on_nominal=known)


def _tone(photos: Sequence[Path], camera: Camera, targets: Targets, stated: float | None) -> Tone:
    """Return the tone curve and the noise of the series from a few of its photographs."""
    chosen = [photos[index] for index in np.unique(np.linspace(0, len(photos) - 1, SAMPLES).astype(int))]
    pictures = [read_picture(path, camera) for path in chosen]
    return estimate_tone(pictures, camera, targets.family, set(targets.ids.tolist()), stated)


def _tone_notes(tone: Tone, stated: float | None) -> list[str]:
    """Return what the user should know about the tone curve."""
    if stated is None and tone.gamma != 1.0:
        return [
            f"the photographs are not linear in light: gamma {tone.gamma:.2f} estimated from {tone.tags} tags and "
            "undone (camera.toml, [photographs] gamma states it)"
        ]
    if abs(tone.bow) > DOUBTFUL_BOW:
        known = "as stored" if tone.gamma == 1.0 else f"with gamma {tone.gamma:g} undone"
        return [
            f"the photographs {known} are not linear in light, and no power makes them so: corners may be shifted "
            f"by about {0.3 * abs(tone.bow):.2f} px towards the tags' centres or away"
        ]
    return []


def _tied(found: ObservationSet) -> tuple[ObservationSet, list[str]]:
    """Return the set without what hangs on a single sight, and what was left out.

    A point with one ray cannot be adjusted, and photographs of a real part always show some tag only once; a
    photograph that is left with less than a tag cannot be placed.

    Raises:
        InfeasibleError: fewer than two photographs remain.
    """
    observations = found.observations
    before = np.bincount(observations.point, minlength=len(found.points))
    while True:
        rays = np.bincount(observations.point, minlength=len(found.points))
        seen = np.bincount(observations.image, minlength=len(found.image_names))
        keep = (rays[observations.point] > 1) & (seen[observations.image] >= CORNERS_PER_TAG)
        if keep.all():
            break
        observations = observations.select(keep)
    if len(np.unique(observations.image)) < 2:
        raise InfeasibleError("expected at least 2 photographs that show the same tags, found none")
    tied, blind = replace(found, observations=observations).without_blind_images()
    notes = []
    once = named(found.point_names, (before > 0) & (rays == 0))
    if once:
        notes.append(f"{len(once)} point(s) are seen in one photograph only and are left out: {listed(once)}")
    if blind:
        notes.append(f"{len(blind)} photograph(s) share no tag with another and are left out: {listed(blind)}")
    return tied, notes


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
    resection = replace(found.problem(), datum="fixed", control=nominal)
    return replace(found, world_from_cam=solve(resection, robust=True).problem.world_from_cam)


def _on_tags_alone(
    measured: Sequence[Sequence[TagMeasurement]],
    names: tuple[str, ...],
    camera: Camera,
    targets: Targets,
    sigma_px: float | None,
    refine: tuple[str, ...],
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
    found = _set(names, seen, camera, poses, points, _observations(measured, seen, sigma_px))
    tied, _ = _tied(found)
    adjusted = estimate(replace(tied.problem(), refine=refine), robust=True)
    points = np.where(adjusted.used[:, None], adjusted.points, points)
    poses[[names.index(name) for name in tied.image_names]] = adjusted.world_from_cam
    scale = seen.size_m / _mean_edge(points, adjusted.used)
    poses[:, :3, 3] *= scale
    return replace(found, world_from_cam=poses, points=points * scale)


def _mean_edge(points: Floats, used: Bools) -> float:
    """Return the mean edge of the tags whose four corners have an estimate."""
    corners = points.reshape(-1, CORNERS_PER_TAG, 3)[used.reshape(-1, CORNERS_PER_TAG).all(axis=1)]
    return float(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).mean())
