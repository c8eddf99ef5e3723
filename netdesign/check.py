"""The verb ``check``: what a study resolves to, what is seen and reached from where, what is infeasible and why."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.files.study import load_task
from netdesign.imaging.plausible import fold_radius_px, image_radius_px
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG, FAMILIES
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.photogrammetry.connectivity import listed
from netdesign.photogrammetry.seating import gap_to_surface
from netdesign.placement.coverage import Coverage, coverage
from netdesign.placement.distances import named_ends
from netdesign.placement.preparation import free_slots, joint_map_of

RARELY_SEEN = 0.05
METRES = 2.0  # mm: a camera that is nearer to its flange was probably given in metres
ON_SURFACE = 0.2  # of an edge: a flat tag on a cylinder whose diameter is twice its edge stays below (0.12)


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What was found: as text, as a record for ``--json``, and the problem that makes the study infeasible, if any."""

    text: str
    record: dict[str, Any]
    problem: InfeasibleError | None


def check_study(path: Path, progress: Progress = silent) -> Findings:
    """Examine a study without searching.

    Raises:
        InputError: the study or an input is wrong.
    """
    task = load_task(path)
    named_ends(task)
    free_slots(task)
    progress("check", 1, 3, "visibility")
    seen = coverage(task)
    progress("check", 2, 3, "robot")
    reach = None if task.cell is None else JointMap.build(task.cell, task.sphere, task.scene.part).share()
    problems = list(seen.obstacles)
    try:
        joint_map_of(task)
    except InfeasibleError as error:
        problems.append(str(error))
    progress("check", 3, 3)
    if reach is not None and reach["free"] == 0.0 and task.study.motion != "workspace":
        worst = max((name for name in reach if name != "free"), key=lambda name: reach[name])
        where = "of the sphere" if task.sphere.depth is None else "that is admissible"
        problems.append(f"the robot reaches no viewpoint {where} (mostly: {worst}, {reach[worst]:.0%} of them)")
    gaps = _gaps(task)
    record = _record(task, seen, reach, problems, gaps)
    if problems and gaps:
        problems.append(_standing_off(gaps, task.study.targets.size_mm))
    problem = InfeasibleError(f"{path}: " + "; ".join(problems)) if problems else None
    return Findings(text=_text(record), record=record, problem=problem)


def _gaps(task: Task) -> dict[str, float]:
    """Return the tags that do not lie on the part, and how far (mm) a corner or the centre is from its surface."""
    targets = task.scene.targets
    centres, corners = targets.centres, targets.points.reshape(-1, CORNERS_PER_TAG, 3)
    places = np.concatenate([centres[:, None], corners], axis=1)
    gap = gap_to_surface(task.scene.part, places.reshape(-1, 3)).reshape(len(centres), -1).max(axis=1)
    found = zip(targets.ids.tolist(), gap.tolist(), strict=True)
    return {str(tag): far * 1e3 for tag, far in found if far > ON_SURFACE * targets.size_m}


def _standing_off(gaps: dict[str, float], size_mm: float) -> str:
    """Return the sentence about tags that do not lie on the part."""
    worst = sorted(gaps.items(), key=lambda item: -item[1])
    names = listed([f"{tag} ({far:.4g} mm)" for tag, far in worst])
    return (
        f"{len(gaps)} tag(s) do not lie on the part, a corner is farther from the surface than "
        f"{ON_SURFACE * size_mm:g} mm: {names}"
    )


def _record(
    task: Task, seen: Coverage, reach: dict[str, float] | None, problems: list[str], gaps: dict[str, float]
) -> dict[str, Any]:
    part, targets = task.scene.part, task.scene.targets
    placed = len(targets.ids) + len(task.left_out)
    near, far = task.camera.depth_of_field()
    table, optics = task.study.camera, ("pixel_um", "f_number", "focus_mm")
    any_optics = table.f_number is not None or table.focus_mm is not None
    return {
        "study": task.study.name,
        "place": "sphere" if task.sphere.depth is None else "admissible stations",
        "study_sha256": task.sha256,
        "part": {"triangles": len(part.faces), "size_mm": np.ptp(part.vertices, axis=0) * 1e3},
        "tags": len(targets.ids),
        "points": len(targets.points),
        "left_out": list(task.left_out),
        "ids_used_up": task.study.targets.spacing_mm is not None and placed == FAMILIES[targets.family].ids,
        "gap_mm": gaps,
        "tag_mm": task.study.targets.size_mm,
        "fold_px": fold_radius_px(task.camera.intrinsics),
        "corner_px": image_radius_px(task.camera),
        "noise": task.study.camera.noise,
        "sigma_px": None if task.camera.corner_noise else task.camera.sigma_px,
        "optics_missing": [name for name in optics if getattr(table, name) is None] if any_optics else [],
        "depth_of_field_mm": [near * 1e3, far * 1e3],
        "sightings": seen.refusals,
        "seen_share": {str(tag): float(share) for tag, share in zip(seen.tag_ids, seen.share, strict=True)},
        "main_reason": {str(tag): reason for tag, reason in zip(seen.tag_ids, seen.main_reason, strict=True)},
        "admissible_share": seen.admissible,
        "least_images": seen.least_images,
        "proved": seen.proved,
        "max_images": seen.max_images,
        "robot": reach,
        "camera_off_flange_mm": None
        if task.cell is None
        else float(np.linalg.norm(task.cell.flange_from_cam[:3, 3])) * 1e3,
        "problems": problems,
    }


def _text(record: dict[str, Any]) -> str:
    size = " x ".join(f"{edge:.1f}" for edge in record["part"]["size_mm"])
    lines = [
        f"study      {record['study']}  ({record['study_sha256'][:12]})",
        f"part       {record['part']['triangles']} triangles, {size} mm",
        f"tags       {record['tags']} tags, {record['points']} object points",
    ]
    if record["ids_used_up"]:
        lines.append("  these are all ids of the family: with a larger targets.spacing_mm they would reach more faces")
    if record["left_out"]:
        names = ", ".join(str(tag) for tag in record["left_out"][:12])
        more = len(record["left_out"]) - 12
        lines.append(
            f"  left out, seen from too little of the {record['place']} (targets.min_seen_share):"
            f" {len(record['left_out'])} tags, {names}{f' and {more} more' if more > 0 else ''}"
        )
    if record["gap_mm"]:
        lines.append(f"  {_standing_off(record['gap_mm'], record['tag_mm'])}")
    lines.append(
        "noise      the detector's model, which takes the place of sigma_px"
        if record["sigma_px"] is None
        else f"noise      {record['sigma_px']:g} px per image coordinate"
    )
    near, far = record["depth_of_field_mm"]
    if record["optics_missing"]:
        lines.append(f"sharp      everywhere: for a depth of field {', '.join(record['optics_missing'])} is missing")
    if np.isfinite(far) or near > 0:
        lines.append(f"sharp      {near:.0f} mm to {far:.0f} mm along the optical axis")
    if record["fold_px"] < record["corner_px"]:
        lines.append(
            f"lens       the distortion folds the image over {record['fold_px']:.0f} px from the principal point, its"
            f" corners are {record['corner_px']:.0f} px away: nothing counts as seen beyond"
        )
    total = sum(record["sightings"].values())
    counts = "  ".join(f"{reason} {count}" for reason, count in record["sightings"].items() if count)
    place = record["place"]
    lines.append(f"sightings  {total} tested over the {place}: {counts}")
    shares = {tag: share for tag, share in record["seen_share"].items() if share < RARELY_SEEN}
    for tag, share in sorted(shares.items(), key=lambda item: item[1])[:10]:
        lines.append(
            f"  tag {tag} is seen from {share:.1%} of the {place}, refused mostly by: {record['main_reason'][tag]}"
        )
    lines.append(f"viewpoints enough points for an image are seen from {record['admissible_share']:.0%} of the {place}")
    if record["least_images"]:
        lines.append(
            f"images     at least {record['least_images']} are needed"
            f" ({'proved' if record['proved'] else 'over sampled stations'}), {record['max_images']} are allowed"
        )
    if record["robot"] is not None:
        parts = "  ".join(f"{name} {share:.1%}" for name, share in record["robot"].items() if share > 0)
        lines.append(f"robot      {parts} of the {place}")
        if 0.0 < record["camera_off_flange_mm"] < METRES:
            lines.append(
                f"  the camera is {record['camera_off_flange_mm']:.3g} mm from the flange, inside it:"
                " robot.flange_from_cam_mm takes millimetres"
            )
    lines.append("feasible   nothing is proved against it" if not record["problems"] else "infeasible")
    return "\n".join(lines)
