"""The verb ``check``: what a study resolves to, what is seen and reached from where, what is infeasible and why."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InfeasibleError
from netdesign.files.study import load_task
from netdesign.imaging.plausible import fold_radius_px, image_radius_px
from netdesign.model.progress import Progress, silent
from netdesign.model.task import Task
from netdesign.motion.joint_map import JointMap
from netdesign.placement.coverage import Coverage, coverage
from netdesign.placement.distances import named_ends
from netdesign.placement.preparation import free_slots, pinned_viewpoints

RARELY_SEEN = 0.05


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
    if task.study.motion != "workspace":
        pinned_viewpoints(task)
    progress("check", 1, 3, "visibility")
    seen = coverage(task)
    progress("check", 2, 3, "robot")
    reach = (
        None
        if task.cell is None or task.sphere.depth is not None
        else JointMap.build(task.cell, task.sphere, task.scene.part).share(task.sphere.elevation)
    )
    progress("check", 3, 3)
    problems = list(seen.obstacles)
    if reach is not None and reach["free"] == 0.0:
        worst = max((name for name in reach if name != "free"), key=lambda name: reach[name])
        problems.append(f"the robot reaches no viewpoint of the sphere (mostly: {worst}, {reach[worst]:.0%} of it)")
    record = _record(task, seen, reach, problems)
    problem = InfeasibleError(f"{path}: " + "; ".join(problems)) if problems else None
    return Findings(text=_text(record), record=record, problem=problem)


def _record(task: Task, seen: Coverage, reach: dict[str, float] | None, problems: list[str]) -> dict[str, Any]:
    part, targets = task.scene.part, task.scene.targets
    near, far = task.camera.depth_of_field()
    return {
        "study": task.study.name,
        "study_sha256": task.sha256,
        "part": {"triangles": len(part.faces), "size_mm": np.ptp(part.vertices, axis=0) * 1e3},
        "tags": len(targets.ids),
        "points": len(targets.points),
        "left_out": list(task.left_out),
        "fold_px": fold_radius_px(task.camera.intrinsics),
        "corner_px": image_radius_px(task.camera),
        "depth_of_field_mm": [near * 1e3, far * 1e3],
        "sightings": seen.refusals,
        "seen_share": {str(tag): float(share) for tag, share in zip(seen.tag_ids, seen.share, strict=True)},
        "main_reason": {str(tag): reason for tag, reason in zip(seen.tag_ids, seen.main_reason, strict=True)},
        "admissible_share": seen.admissible,
        "least_images": seen.least_images,
        "proved": seen.proved,
        "max_images": seen.max_images,
        "robot": reach,
        "problems": problems,
    }


def _text(record: dict[str, Any]) -> str:
    size = " x ".join(f"{edge:.1f}" for edge in record["part"]["size_mm"])
    lines = [
        f"study      {record['study']}  ({record['study_sha256'][:12]})",
        f"part       {record['part']['triangles']} triangles, {size} mm",
        f"tags       {record['tags']} tags, {record['points']} object points",
    ]
    if record["left_out"]:
        names = ", ".join(str(tag) for tag in record["left_out"][:12])
        more = len(record["left_out"]) - 12
        lines.append(
            f"  left out, seen from too little of the sphere (targets.min_seen_share): {len(record['left_out'])} tags, "
            f"{names}{f' and {more} more' if more > 0 else ''}"
        )
    near, far = record["depth_of_field_mm"]
    if np.isfinite(far) or near > 0:
        lines.append(f"sharp      {near:.0f} mm to {far:.0f} mm along the optical axis")
    if record["fold_px"] < record["corner_px"]:
        lines.append(
            f"lens       the distortion folds the image over {record['fold_px']:.0f} px from the principal point, its"
            f" corners are {record['corner_px']:.0f} px away: nothing counts as seen beyond"
        )
    total = sum(record["sightings"].values())
    counts = "  ".join(f"{reason} {count}" for reason, count in record["sightings"].items() if count)
    lines.append(f"sightings  {total} tested over the sphere: {counts}")
    shares = {tag: share for tag, share in record["seen_share"].items() if share < RARELY_SEEN}
    for tag, share in sorted(shares.items(), key=lambda item: item[1])[:10]:
        lines.append(
            f"  tag {tag} is seen from {share:.1%} of the sphere, refused mostly by: {record['main_reason'][tag]}"
        )
    place = "sphere" if record["proved"] else "stations"
    lines.append(f"viewpoints {record['admissible_share']:.0%} of the {place} sees enough points for an image")
    if record["least_images"]:
        lines.append(
            f"images     at least {record['least_images']} are needed"
            f" ({'proved' if record['proved'] else 'over sampled stations'}), {record['max_images']} are allowed"
        )
    if record["robot"] is not None:
        parts = "  ".join(f"{name} {share:.1%}" for name, share in record["robot"].items() if share > 0)
        lines.append(f"robot      {parts} of the sphere")
    lines.append("feasible   nothing is proved against it" if not record["problems"] else "infeasible")
    return "\n".join(lines)
