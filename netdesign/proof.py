"""One planned network against reality: photographed, measured, adjusted, compared.

The stations are executed as a robot would (nominal pose plus a seeded error), the tags rendered, detected and fitted,
the bundle adjusted from nominal values with GTSAM. A failure at any step is kept with its reason.
"""

import hashlib
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.adjustment.absolute import absolute_comparison, absolute_prediction, repeatability_priors
from netdesign.adjustment.bundle import adjust
from netdesign.adjustment.compare import compare
from netdesign.adjustment.correlated import correlated_errors
from netdesign.adjustment.estimate import estimate
from netdesign.adjustment.lengths import length_test
from netdesign.adjustment.problem import BundleProblem
from netdesign.errors import EnvironmentProblem, InputError, NetdesignError
from netdesign.files.adjustment import absolute_payload, adjustment_payload, length_payload, validation_payload
from netdesign.files.design_json import PlannedNetwork
from netdesign.files.store import read_json, write_json, write_text
from netdesign.imageset import measure_images, observations_of, render_images
from netdesign.imaging.measure import Gates, TagMeasurement
from netdesign.imaging.photograph import RendererName, Shoot
from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Floats
from netdesign.model.frames import exp_rotation, pose
from netdesign.model.network import Observations
from netdesign.model.progress import Progress, silent
from netdesign.model.results import PointPrecision
from netdesign.model.scene import CORNERS_PER_TAG, Targets
from netdesign.model.task import Task
from netdesign.photogrammetry.intersection import convergence
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_error import total_covariance
from netdesign.photogrammetry.visibility import sightings
from netdesign.truth import image_name

# The detector's own limits; which tags are wanted is for the plan to say, up to 70 deg and a robot's error.
GATES = Gates(max_incidence=float(np.radians(71.0)))
ONE_PLACE = np.radians(0.3) ** 2 / 4.0  # convergence of two rays at 0.3 degrees
OUTLIER_SIGNIFICANCE = 1e-4  # data snooping at 1e-3 would bias s0² by 0.7 %


def executed_poses(task: Task, network: PlannedNetwork, repeat: int = 0) -> Floats:
    """Return where the camera really stood, (n, 4, 4) m: the plan plus a robot's error, drawn from the study's seed.

    The error has the robot's repeatability where the study states it, else the jitter of [validation].
    """
    settings, count = task.study.validation, len(network.world_from_cam)
    random = np.random.default_rng([task.study.seed, network.id, repeat])
    position, rotation = (0.0, 0.0) if task.cell is None else task.cell.repeatability
    shift = random.normal(scale=position or settings.pose_jitter_mm * 1e-3, size=(count, 3))
    turn = random.normal(scale=rotation or settings.pose_jitter_mrad * 1e-3, size=(count, 3))
    error: Floats = network.world_from_cam @ pose(exp_rotation(turn), shift)
    return error


def photograph(
    task: Task,
    network: PlannedNetwork,
    out: Path,
    repeat: int,
    executor: Executor | None,
    progress: Progress = silent,
    renderer: RendererName = "pyrender",
) -> list[Path]:
    """Render what the camera sees from the executed poses; the noise seed belongs to network and repeat."""
    seed = int(np.random.SeedSequence([task.study.seed, network.id, repeat]).generate_state(1)[0])
    shoot = Shoot(seed=seed, supersample=task.study.validation.supersample, renderer=renderer)
    poses = executed_poses(task, network, repeat)
    return render_images(
        task.scene, task.camera, task.limits, poses, out, shoot,
        executor=executor, progress=progress, study_sha256=task.sha256,
    )  # fmt: skip


def prove_network(
    task: Task, network: PlannedNetwork, folder: Path, repeat: int, level: float, executor: Executor | None
) -> None:
    """Write a network's images, observations.csv, adjustment.json and validation.json; a failure keeps its reason."""
    (folder / "adjustment.json").unlink(missing_ok=True)
    names = [image_name(index) for index in range(len(network.world_from_cam))]
    point_ids = task.scene.targets.point_ids
    paths = photograph(task, network, folder, repeat, executor)
    measured = measure_images(paths, task.camera, task.scene.targets, gates=GATES, executor=executor)
    observations, tag_covariances, unused = observations_of(_as_planned(task, network, measured), task.scene.targets)
    observations, tag_covariances, alone = _intersected(
        observations, tag_covariances, task.scene.targets, network.world_from_cam
    )
    write_text(folder / "observations.csv", observations_csv(observations, names, point_ids))
    record: dict[str, Any] = {
        "network": network.id,
        "repeat": repeat,
        "plan": _plan_key(network),
        "tags_not_used": unused,
        "tags_not_measured": alone,
        "image_points": len(observations),
    }
    try:
        start, adjustment = _adjusted(task, network, observations, names)
        joint, sums = correlated_errors(adjustment, _by_image_and_tag(observations, tag_covariances))
        limited, total = predictions(task, network)
        truth = task.scene.targets.points
        validation = compare(
            truth, adjustment, limited, total, level, seed=task.study.seed, joint_covariance=joint, sums=sums
        )
        lengths = length_payload(length_test(truth, adjustment), point_ids)
        absolute = _in_robot_frame(task, network, start, level)
    except EnvironmentProblem:
        raise
    except NetdesignError as error:
        record |= {"verdict": "failed", "passed": False, "reasons": [str(error)], "warnings": []}
    else:
        record |= validation_payload(validation, point_ids) | lengths | absolute
        record["warnings"] = [*record["warnings"], *alone]
        record["verdict"] = "pass" if validation.passed else "fail"
        record["rejected_image_points"] = len(adjustment.rejected)
        write_json(
            folder / "adjustment.json", "adjustment", adjustment_payload(adjustment, names, point_ids), task.sha256
        )
    write_json(folder / "validation.json", "network-validation", record, task.sha256)


def predictions(task: Task, network: PlannedNetwork) -> tuple[PointPrecision, PointPrecision]:
    """Return what the design promises: P0, limited, and P1, total error propagation at the planned stations."""
    poses, points = network.world_from_cam, task.scene.targets.points
    visible = sightings(task.scene, task.camera, poses, task.limits).visible
    sigma = sighting_sigma(task.camera, poses, task.scene.targets)
    limited = PointPrecision(
        covariance=limited_covariance(poses, points, task.camera.intrinsics, visible, sigma),
        rays=visible.sum(axis=0),
        propagation="limited",
        datum="exterior orientation error-free",
    )
    return limited, total_covariance(poses, points, task.camera.intrinsics, visible, sigma).precision


def is_proved(task: Task, network: PlannedNetwork, folder: Path) -> bool:
    """Whether the network was validated for this study and these stations."""
    if not (folder / "validation.json").is_file():
        return False
    try:
        record = read_json(folder / "validation.json", "network-validation")
    except InputError:
        return False
    complete = "tags_not_measured" in record  # absent in earlier versions
    return bool(complete and record.get("study_sha256") == task.sha256 and record.get("plan") == _plan_key(network))


def observations_csv(observations: Observations, names: list[str], point_ids: tuple[str, ...]) -> str:
    """Return observations.csv: one measured corner a line."""
    lines = ["image,tag,corner,x_px,y_px,sxx_px2,sxy_px2,syy_px2"]
    for i, j, (x, y), s in zip(
        observations.image, observations.point, observations.xy_px, observations.covariance, strict=True
    ):
        tag, corner = point_ids[j].split(".")
        values = ",".join(repr(float(value)) for value in (x, y, s[0, 0], s[0, 1], s[1, 1]))
        lines.append(f"{names[i]},{tag},{corner},{values}")
    return "\n".join(lines) + "\n"


def _adjusted(
    task: Task, network: PlannedNetwork, observations: Observations, names: list[str]
) -> tuple[BundleProblem, Adjustment]:
    """Return the problem without gross errors, from nominal values, and GTSAM's free adjustment of it."""
    start = BundleProblem(
        observations=observations,
        camera_of_image=np.zeros(len(names), dtype=np.int64),
        intrinsics=task.camera.intrinsics[None],
        world_from_cam=network.world_from_cam,
        points=task.scene.targets.points,
        image_names=names,
        point_names=task.scene.targets.point_ids,
    )
    cleaned = estimate(start, robust=True, significance=OUTLIER_SIGNIFICANCE)
    adjustment = adjust(
        cleaned.observations,
        task.camera,
        network.world_from_cam,
        task.scene.targets.points,
        image_names=names,
        point_names=task.scene.targets.point_ids,
    )
    # Only the first adjustment knows which points lost their rays to its outlier test.
    adjustment = replace(adjustment, rejected=cleaned.rejected, warnings=cleaned.warnings)
    return replace(start, observations=cleaned.observations), adjustment


def _in_robot_frame(task: Task, network: PlannedNetwork, problem: BundleProblem, level: float) -> dict[str, Any]:
    """Return the entry "absolute" of validation.json for a robot whose repeatability is stated, else nothing."""
    poses = network.world_from_cam
    priors = None if task.cell is None else repeatability_priors(task.cell.repeatability, poses)
    if priors is None:
        return {}
    targets = task.scene.targets
    visible = sightings(task.scene, task.camera, poses, task.limits).visible
    sigma = sighting_sigma(task.camera, poses, targets)
    design = absolute_prediction(targets.points, priors, task.camera.intrinsics, visible, sigma)
    return absolute_payload(absolute_comparison(targets.points, problem, priors, level), design, targets.point_ids)


def _by_image_and_tag(observations: Observations, covariances: list[Floats]) -> dict[tuple[int, int], Floats]:
    """Return the covariances of tags by (image, tag) where observations are listed tag by tag."""
    image, point = observations.image[::CORNERS_PER_TAG], observations.point[::CORNERS_PER_TAG]
    keys = zip(image.tolist(), (point // CORNERS_PER_TAG).tolist(), strict=True)
    return dict(zip(keys, covariances, strict=True))


def _as_planned(
    task: Task, network: PlannedNetwork, measured: list[list[TagMeasurement]]
) -> list[list[TagMeasurement]]:
    """Return the measurements with a reason against those that the plan does not count on.

    What the plan counts on is decided at the planned stations: a robot that stands a tenth of a degree off must not
    turn a planned sighting at the limit of incidence into none.
    """
    planned = sightings(task.scene, task.camera, network.world_from_cam, task.limits).visible_tags
    row = {tag: index for index, tag in enumerate(task.scene.targets.ids.tolist())}

    def judged(image: int, tag: TagMeasurement) -> TagMeasurement:
        wanted = tag.rejected or planned[image, row[tag.tag_id]]
        return tag if wanted else replace(tag, rejected="not counted on by the plan")

    return [[judged(image, tag) for tag in tags] for image, tags in enumerate(measured)]


def _intersected(
    observations: Observations, covariances: list[Floats], targets: Targets, planned: Floats
) -> tuple[Observations, list[Floats], list[str]]:
    """Return the observations without tags that one planned station alone shows, and what those are.

    They have no position: the second picture of a station that a plan takes twice stands beside the first by what the
    robot errs, which tells next to nothing.
    """
    tag = observations.point[::CORNERS_PER_TAG] // CORNERS_PER_TAG
    image = observations.image[::CORNERS_PER_TAG]
    images = np.bincount(tag, minlength=len(targets.ids))
    ray = targets.centres[tag] - planned[image, :3, 3]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    one_place = (images > 1) & (convergence(ray, tag, len(targets.ids)) < ONE_PLACE)
    kept = (images[tag] > 1) & ~one_place[tag]
    rows = np.repeat(kept, CORNERS_PER_TAG)
    left = Observations(
        image=observations.image[rows],
        point=observations.point[rows],
        xy_px=observations.xy_px[rows],
        covariance=observations.covariance[rows],
    )
    alone = [
        f"tag {targets.ids[index]}: measured in {images[index]} image(s), at least 2 needed"
        for index in np.flatnonzero(images < 2)
    ]
    alone += [
        f"tag {targets.ids[index]}: measured in {images[index]} images of one station, at least 2 stations needed"
        for index in np.flatnonzero(one_place)
    ]
    return left, [item for item, keep in zip(covariances, kept, strict=True) if keep], alone


def _plan_key(network: PlannedNetwork) -> str:
    """Return what identifies a plan: a validation of other stations is stale."""
    return hashlib.sha256(np.round(network.world_from_cam, 12).tobytes()).hexdigest()
