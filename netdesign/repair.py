"""The verb ``repair``: which image of a network can be spared, which one to add next, and what each is worth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InfeasibleError, InputError
from netdesign.files.robot_program import stations_csv
from netdesign.files.stations import parse_stations, stations_table
from netdesign.files.store import demand_writable, write_text
from netdesign.files.study import load_task
from netdesign.model.arrays import Floats
from netdesign.model.progress import Progress, silent
from netdesign.placement.repair import Addition, Quality, Standing

UM = 1e-6
NAME = 35  # characters before the figures of a line


@dataclass(frozen=True, kw_only=True)
class Repaired:
    """What was found: as text, and as a record for ``--json``."""

    text: str
    record: dict[str, Any]


def repair_study(
    study: Path, stations: str | None, add: int, output: Path | None = None, progress: Progress = silent
) -> Repaired:
    """Examine a network that stands: drop each of its images, add ``add`` images one after the other.

    Args:
        stations: file of the network, None for ``viewpoints.existing`` of the study.
        output: CSV to write, the network with its additions.

    Raises:
        InputError: the study or the stations cannot be read, or none are named.
        InfeasibleError: no admissible station sees enough for an image.
    """
    task = load_task(study)
    if stations is not None:
        poses = parse_stations(stations_table(stations, Path()), Path(stations))
    elif len(task.existing):
        poses = task.existing
    else:
        raise InputError(f"{study}: expected --stations FILE, or viewpoints.existing in the study; found neither")
    if output is not None:
        demand_writable(output)
    standing = Standing(task)
    now, dropped = standing.quality(poses), standing.drops(poses)
    added: list[Addition] = []
    grown = poses
    for number in range(add):
        progress("repair", number, add)
        found = standing.addition(grown)
        if found is None:
            raise InfeasibleError(
                f"{study}: no admissible station sees the {task.limits.min_points_per_image} object points that"
                " visibility.min_points_per_image asks for; `netdesign check` counts the reasons"
            )
        added.append(found)
        grown = np.concatenate([grown, found.world_from_cam[None]])
    progress("repair", add, max(add, 1))
    if output is not None:
        write_text(output, stations_csv(task.sphere.placed(grown)[0], grown, None, ()))
    record = {
        "stations": len(poses),
        "min_rays": task.limits.min_rays,
        "one_radius": task.sphere.depth is None,
        "now": _quality(now),
        "drop": [{"image": image, **_quality(quality)} for image, quality in enumerate(dropped)],
        "add": [
            {
                "viewpoint_deg": np.degrees(item.viewpoint[:2]),
                "radius_mm": 1e3 * float(np.linalg.norm(item.world_from_cam[:3, 3] - task.sphere.centre)),
                "world_from_cam_mm": _mm(item.world_from_cam),
                **_quality(item.quality),
            }
            for item in added
        ],
    }
    return Repaired(text=_text(record, output), record=record)


def _quality(quality: Quality) -> dict[str, Any]:
    return {
        "images": quality.images,
        "f1_mm2": quality.f1 * 1e6,
        "rms_sigma_um": float(np.sqrt(quality.f1)) / UM,
        "max_sigma_um": quality.worst / UM,
        "total_rms_sigma_um": None if quality.total_rms is None else quality.total_rms / UM,
        "fewest_rays": quality.rays,
        "points_below_min_rays": quality.short,
        "images_below_min_points": quality.poor,
    }


def _mm(pose: Floats) -> Floats:
    result = pose.copy()
    result[:3, 3] *= 1e3
    return result


def _text(record: dict[str, Any], output: Path | None) -> str:
    """Return the tables that a person reads: the network, its images from the least to the most needed, additions."""
    now = record["now"]
    head = f"{'':<{NAME}}{'rms sigma':>10}{'':>9}{'largest':>10}{'total rms':>11}{'rays':>6}"
    lines = [head, _line(f"now, {now['images']} images", now, None)]
    drops = sorted(record["drop"], key=lambda item: (item["points_below_min_rays"], item["f1_mm2"], item["image"]))
    lines += [_line(f"  without image {item['image'] + 1}", item, now) for item in drops]
    before = now
    for item in record["add"]:
        alpha, beta = item["viewpoint_deg"]
        away = "" if record["one_radius"] else f", {item['radius_mm']:.0f} mm"
        lines.append(_line(f"  with one at {alpha:.1f}, {beta:.1f}{away}", item, before))
        before = item
    below = now["points_below_min_rays"]
    if below:
        lines.append(f"{below} object points have fewer than {record['min_rays']} rays now")
    if now["images_below_min_points"]:
        lines.append(f"{now['images_below_min_points']} of the images see too few object points")
    distance = "" if record["one_radius"] else " and distance from centre_mm"
    lines += [
        "sigmas in um; images counted from 1 in the order of the file",
        f"additions, one after the other, at azimuth, elevation in deg{distance}",
        "the change is that of the rms sigma against the line it starts from",
    ]
    if output is not None:
        lines.append(f"{output}: {now['images'] + len(record['add'])} stations")
    return "\n".join(lines)


def _line(name: str, quality: dict[str, Any], against: dict[str, Any] | None) -> str:
    change = ""
    if against is not None and np.isfinite(quality["rms_sigma_um"]) and np.isfinite(against["rms_sigma_um"]):
        change = f"{100 * (quality['rms_sigma_um'] / against['rms_sigma_um'] - 1):+.1f}%"
    total = quality["total_rms_sigma_um"]
    rays = f"{quality['fewest_rays']}"
    note = f"  {quality['points_below_min_rays']} points below" if quality["points_below_min_rays"] else ""
    return (
        f"{name:<{NAME}}{_sigma(quality['rms_sigma_um']):>10} {change:>8}{_sigma(quality['max_sigma_um']):>10}"
        f"{'open' if total is None else _sigma(total):>11}{rays:>6}{note}"
    )


def _sigma(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else "open"
