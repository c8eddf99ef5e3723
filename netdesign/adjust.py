"""The verb ``adjust``: bundle adjustment of an observation set or of photographs of a tagged part.

    outcome = adjust_folder(folder, sigma_px=None, datum="free", …, out=None, progress=silent)

reads the set, adjusts it, and writes adjustment.json beside it or into ``out``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.nominal import misplaced_tags
from netdesign.adjustment.problem import BundleProblem
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.adjustment import adjustment_payload
from netdesign.files.colmap import MODEL_FILES
from netdesign.files.datum_tables import read_control, read_pose_priors, read_scale_bars
from netdesign.files.observations import ObservationSet, read_observation_set
from netdesign.files.store import plain, write_json
from netdesign.imaging.plausible import fold_radius_px
from netdesign.model.adjustment import Adjustment, Datum
from netdesign.model.arrays import Bools
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.photo_set import is_photo_set, read_photo_set
from netdesign.photogrammetry.connectivity import listed
from netdesign.photogrammetry.observation_equations import parameter_matrix
from netdesign.reporting.adjustment import adjustment_text
from netdesign.run_folder import belongs_to_validation

USUAL_ITERATIONS = 8
# In a network's folder of a run adjustment.json is what validation.json speaks of: report and campaign read it.
BESIDE_VALIDATION = "adjustment-own.json"


@dataclass(frozen=True, kw_only=True)
class AdjustOutcome:
    """What the verb has to show: the record as written to adjustment.json, and a summary in text."""

    record: dict[str, Any]
    text: str
    adjustment: Adjustment
    path: Path


def adjust_folder(
    folder: Path,
    *,
    sigma_px: float | None = None,
    datum: Datum | None = None,
    datum_points: Sequence[str] | None = None,
    control: Path | None = None,
    scale_bars: Path | None = None,
    poses: Path | None = None,
    refine: Sequence[str] | None = None,
    robust: bool = False,
    out: Path | None = None,
    progress: Progress = silent,
) -> AdjustOutcome:
    """Adjust an observation set or an image set and write adjustment.json.

    Args:
        sigma_px: image-coordinate noise, instead of what the set says.
        datum: None takes what the set holds first of control points, pose priors, scale bars; else free.
        datum_points: names of the points that carry the inner constraints, None or none for all.
        control, scale_bars, poses: files, instead of control.csv, scalebars.csv and poses.csv in the folder.
        refine: interior parameters to estimate.  robust: find and reject gross errors.
        out: folder for adjustment.json, None for ``folder``. In a network's folder of a run, whose adjustment.json
            belongs to its validation, the file is called adjustment-own.json.

    Raises:
        InputError: what was read is wrong.  InfeasibleError: the network does not determine what is asked for.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with an observation set or an image set, found none")
    place = out or folder
    if place.exists() and not place.is_dir():
        raise InputError(f"{place}: expected a folder to write adjustment.json into, found a file")
    path = place / (BESIDE_VALIDATION if belongs_to_validation(place) else "adjustment.json")
    progress("read", 0, 1)
    found, blind, notes, on_nominal = _read(folder, sigma_px, tuple(refine or ()), progress)
    progress("read", 1, 1)
    control_path = _table(control, folder / "control.csv")
    bars_path = _table(scale_bars, folder / "scalebars.csv")
    poses_path = _table(poses, folder / "poses.csv")
    names = tuple(refine or ())
    try:
        for row in found.intrinsics:
            parameter_matrix(names, row)
    except ValueError as error:
        raise InputError(str(error)) from None
    problem = replace(
        found.problem(),
        refine=names,
        datum=datum or _usual_datum(control_path, poses_path, bars_path),
        datum_points=_mask(datum_points, found.point_names),
        control=None if control_path is None else read_control(control_path, found.point_names),
        bars=None if bars_path is None else read_scale_bars(bars_path, found.point_names),
        priors=(
            None
            if poses_path is None
            else read_pose_priors(poses_path, found.image_names, found.world_from_cam, left_out=blind)
        ),
    )

    def iterated(iteration: int, cost: float) -> None:
        progress("adjust", iteration - 1, max(USUAL_ITERATIONS, iteration), f"sum of squares {cost:.6g}")

    beyond = _beyond_fold(found)
    try:
        adjustment = estimate(problem, robust=robust, sigma_known=found.sigma_known, progress=iterated)
    except InfeasibleError as error:
        raise InfeasibleError("; ".join([str(error), *beyond])) from None
    progress("adjust", USUAL_ITERATIONS, USUAL_ITERATIONS)
    adjustment = replace(adjustment, warnings=(*notes, *beyond, *_notes(problem, found), *adjustment.warnings))
    if on_nominal:
        adjustment = replace(adjustment, warnings=(*adjustment.warnings, *_misplaced(adjustment, found)))
    record = plain(adjustment_payload(adjustment, found.image_names, found.point_names))
    try:
        write_json(path, "adjustment", record)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); say where to with -o OUT") from None
    text = f"{adjustment_text(adjustment)}\nwritten      {path}"
    return AdjustOutcome(record=record, text=text, adjustment=adjustment, path=path)


def _read(
    folder: Path, sigma_px: float | None, refine: tuple[str, ...], progress: Progress
) -> tuple[ObservationSet, tuple[str, ...], tuple[str, ...], bool]:
    """Return what the folder holds, the images left out, what is to be said, and whether points are nominal tags."""
    if is_photo_set(folder):
        photos = read_photo_set(folder, sigma_px, progress, refine)
        return photos.observations, (), photos.notes, photos.on_nominal
    if any((folder / name).is_file() for name in MODEL_FILES):
        found, blind = read_observation_set(folder, sigma_px).without_blind_images()
        return (
            found,
            blind,
            (f"{len(blind)} image(s) without image points are left out: {listed(blind)}",) * bool(blind),
            False,
        )
    raise InputError(
        f"{folder}: expected a COLMAP text model ({', '.join(MODEL_FILES)}) or camera.toml with photographs"
    )


def _table(given: Path | None, usual: Path) -> Path | None:
    """Return the file that was named, else the usual one if it is there."""
    return given if given is not None else usual if usual.is_file() else None


def _usual_datum(control: Path | None, poses: Path | None, bars: Path | None) -> Datum:
    if control is not None:
        return "control"
    if poses is not None:
        return "poses"
    return "free" if bars is None else "scale"


def _mask(names: Sequence[str] | None, point_names: Sequence[str]) -> Bools | None:
    """Return which points carry the datum.

    Raises:
        InputError: a name that no point has.
    """
    if not names:
        return None
    known = set(point_names)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"datum-points: expected names of object points, found {unknown[0]!r}")
    return np.isin(np.array(point_names), np.array(names))


def _beyond_fold(found: ObservationSet) -> list[str]:
    """Return that image points lie where the given distortion carries no ray, in one line or none."""
    camera = found.camera_of_image[found.observations.image]
    reach = np.array([fold_radius_px(row) for row in found.intrinsics])[camera]
    radius = np.linalg.norm(found.observations.xy_px - found.intrinsics[camera, 2:4], axis=1)
    beyond = radius > reach
    if not beyond.any():
        return []
    images = [found.image_names[index] for index in np.unique(found.observations.image[beyond]).tolist()]
    return [
        f"{int(beyond.sum())} image point(s) lie up to {radius[beyond].max():.0f} px from the principal point, but the "
        f"distortion k1, k2 of the camera carries no ray beyond {reach[beyond].min():.0f} px: it is not that of these "
        f"images ({listed(images)})"
    ]


def _misplaced(adjustment: Adjustment, found: ObservationSet) -> list[str]:
    """Return which tags were not measured where targets.csv says, in one line or none."""
    deviation, wrong = misplaced_tags(adjustment.points, found.points, adjustment.used)
    tags = [name.partition(".")[0] for name in found.point_names[::CORNERS_PER_TAG]]
    if not wrong.any():
        return []
    places = [f"{tag} ({1e3 * off:.1f} mm)" for tag, off, bad in zip(tags, deviation, wrong, strict=True) if bad]
    return [
        f"{len(places)} tag(s) lie far from their place in targets.csv, wrong ids or wrong nominal coordinates: "
        f"{listed(places, 12)}"
    ]


def _notes(problem: BundleProblem, found: ObservationSet) -> list[str]:
    """Return what was read and is not used, or was assumed."""
    notes = []
    if not found.sigma_known:
        notes.append(
            "nothing gives the noise of the image points: 1 px is assumed, a-posteriori sigmas are right anyway"
        )
    if problem.control is not None and problem.active_control is None:
        notes.append(f"control points are not used by datum {problem.datum}")
    if problem.priors is not None and problem.active_priors is None:
        notes.append(f"pose priors are not used by datum {problem.datum}")
    if problem.bars is not None and problem.datum == "free":
        notes.append("scale bars are not used by datum free: lengths refer to the scale of the approximate values")
    if problem.datum_points is not None and problem.datum not in ("free", "scale"):
        notes.append(f"datum points are not used by datum {problem.datum}")
    return notes
