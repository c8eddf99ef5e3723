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
from netdesign.adjustment.problem import BundleProblem
from netdesign.errors import InputError
from netdesign.files.adjustment import adjustment_payload
from netdesign.files.colmap import MODEL_FILES
from netdesign.files.observations import ObservationSet, read_control, read_observation_set, read_scale_bars
from netdesign.files.store import plain, write_json
from netdesign.model.adjustment import Adjustment, Datum
from netdesign.model.arrays import Bools
from netdesign.model.progress import Progress, silent
from netdesign.photo_set import is_photo_set, read_photo_set
from netdesign.photogrammetry.observation_equations import parameter_matrix


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
    refine: Sequence[str] | None = None,
    robust: bool = False,
    out: Path | None = None,
    progress: Progress = silent,
) -> AdjustOutcome:
    """Adjust an observation set or an image set and write adjustment.json.

    Args:
        sigma_px: image-coordinate noise, instead of what the set says.
        datum: None takes control if the set has control points, else scale if it has scale bars, else free.
        datum_points: names of the points that carry the inner constraints, None or none for all.
        control, scale_bars: files, instead of control.csv and scalebars.csv in the folder.
        refine: interior parameters to estimate.  robust: find and reject gross errors.
        out: folder for adjustment.json, None for ``folder``.

    Raises:
        InputError: what was read is wrong.  InfeasibleError: the network does not determine what is asked for.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with an observation set or an image set, found none")
    progress("adjust", 0, 3, "read")
    found, left_out = _read(folder, sigma_px, progress)
    control_path, bars_path = control or folder / "control.csv", scale_bars or folder / "scalebars.csv"
    has_control, has_bars = control is not None or control_path.is_file(), scale_bars is not None or bars_path.is_file()
    chosen: Datum = datum or ("control" if has_control else "scale" if has_bars else "free")
    names = tuple(refine or ())
    try:
        for row in found.intrinsics:
            parameter_matrix(names, row)
    except ValueError as error:
        raise InputError(str(error)) from None
    problem = BundleProblem(
        observations=found.observations,
        camera_of_image=found.camera_of_image,
        intrinsics=found.intrinsics,
        world_from_cam=found.world_from_cam,
        points=found.points,
        image_names=found.image_names,
        point_names=found.point_names,
        refine=names,
        datum=chosen,
        datum_points=_mask(datum_points, found.point_names),
        control=read_control(control_path, found.point_names) if has_control else None,
        bars=read_scale_bars(bars_path, found.point_names) if has_bars else None,
    )
    progress("adjust", 1, 3, "adjust")
    adjustment = estimate(problem, robust=robust, sigma_known=found.sigma_known)
    adjustment = replace(adjustment, warnings=(*left_out, *_notes(problem, found), *adjustment.warnings))
    progress("adjust", 2, 3, "write")
    record = adjustment_payload(adjustment, found.image_names, found.point_names)
    path = (out or folder) / "adjustment.json"
    write_json(path, "adjustment", record)
    progress("adjust", 3, 3)
    return AdjustOutcome(record=plain(record), text=_summary(adjustment, path), adjustment=adjustment, path=path)


def _read(folder: Path, sigma_px: float | None, progress: Progress) -> tuple[ObservationSet, tuple[str, ...]]:
    """Return what the folder holds, and what of it was left out."""
    if is_photo_set(folder):
        photos = read_photo_set(folder, sigma_px, progress)
        return photos.observations, photos.notes
    if any((folder / name).is_file() for name in MODEL_FILES):
        return read_observation_set(folder, sigma_px), ()
    raise InputError(
        f"{folder}: expected a COLMAP text model ({', '.join(MODEL_FILES)}) or camera.toml with photographs"
    )


def _mask(names: Sequence[str] | None, point_names: Sequence[str]) -> Bools | None:
    """Return which points carry the datum.

    Raises:
        InputError: a name that no point has.
    """
    if not names:
        return None
    unknown = [name for name in names if name not in point_names]
    if unknown:
        raise InputError(f"datum-points: expected names of object points, found {unknown[0]!r}")
    return np.isin(np.array(point_names), np.array(names))


def _notes(problem: BundleProblem, found: ObservationSet) -> list[str]:
    """Return what was read and is not used, or was assumed."""
    notes = []
    if not found.sigma_known:
        notes.append(
            "nothing gives the noise of the image points: 1 px is assumed, a-posteriori sigmas are right anyway"
        )
    if problem.control is not None and problem.datum not in ("control", "fixed"):
        notes.append(f"control points are not used by datum {problem.datum}")
    if problem.bars is not None and problem.datum == "free":
        notes.append("scale bars are not used by datum free: lengths refer to the scale of the approximate values")
    if problem.datum_points is not None and problem.datum in ("control", "fixed"):
        notes.append(f"datum points are not used by datum {problem.datum}")
    return notes


def _summary(adjustment: Adjustment, path: Path) -> str:
    """Return what a person wants to know first; every sigma with its datum."""
    used = adjustment.used
    factor = adjustment.sigma0 if np.isfinite(adjustment.sigma0) else 1.0
    variance = np.trace(adjustment.point_covariance[used], axis1=1, axis2=2) / 3.0 * factor**2
    rms_px = float(np.sqrt((adjustment.residuals_px**2).mean()))
    lines = [
        f"datum        {adjustment.datum}",
        f"images       {len(adjustment.world_from_cam)}, points {int(used.sum())}, "
        f"image points {len(adjustment.observations)}, rejected {len(adjustment.rejected)}",
        f"observations {adjustment.n_observations}, unknowns {adjustment.n_unknowns}, datum constraints "
        f"{adjustment.n_datum}, redundancy {adjustment.redundancy}",
        f"sigma0       {adjustment.sigma0:.4f} (a priori 1), residuals {rms_px:.4f} px rms, "
        f"{adjustment.iterations} iterations",
        f"point sigma  {np.sqrt(variance.mean()) * 1e6:.4g} um rms, {np.sqrt(variance.max(initial=0.0)) * 1e6:.4g} um "
        "worst (per coordinate, a posteriori)",
        f"redundancy   {adjustment.redundancy_numbers.mean(axis=0)[0]:.3f} in x, "
        f"{adjustment.redundancy_numbers.mean(axis=0)[1]:.3f} in y on average",
    ]
    sigma = np.sqrt(np.maximum(np.diag(adjustment.parameter_covariance), 0.0)) * factor
    share = max(len(sigma) // len(adjustment.intrinsics), 1)
    for index, (name, value) in enumerate(zip(adjustment.parameter_names, sigma.tolist(), strict=True)):
        row = adjustment.intrinsics[index // share]
        key = name.split()[-1]
        position = 0 if key == "f" else ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2").index(key)
        lines.append(f"{name:<12} {row[position]:.9g} +- {value:.3g}")
    lines += [f"warning      {text}" for text in adjustment.warnings]
    return "\n".join([*lines, f"written      {path}"])
