"""Measuring the detector: a grid of tag sizes and incidences is rendered, detected and fitted, and compared with truth.

The pipeline is the real one. Out of it come k and the floor of the closed form in ``photogrammetry/precision.py``
(the exponents stay), and per cell of the grid bias, systematic error, noise and consistency (NEES), which say whether
the closed form may be believed.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InputError
from netdesign.files.store import demand_writable, write_json
from netdesign.files.study import load_task
from netdesign.imageset import each, worker_pool
from netdesign.imaging.measure import measure
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera, CornerNoise
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG, FAMILIES, Part, Scene, Targets
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.precision import corner_rms
from netdesign.truth import camera_record

SIDES_PX = (20.0, 30.0, 50.0, 85.0, 140.0)
INCIDENCES_DEG = (0.0, 35.0, 60.0)
SMALLEST_CELL_PX = 1.5  # across the tilt axis: the pipeline's own limit (imaging.measure.Gates)
REPLICATES = 16  # noise realisations of one picture
ACROSS, DOWN = 4, 3  # tags of one picture, each turned at random
FOCAL_PX = 6000.0  # long, so that size and incidence hardly vary over the picture
TAG_SIZE_M = 0.02
NEES_BAND = (0.8, 1.3)


@dataclass(frozen=True, kw_only=True)
class NoiseCell:
    """One size and incidence.

    Attributes:
        tags: measured tag pictures.  missed: not detected.  rejected: by the gates.
        bias_px: (2,) mean error in x and y.  shrink_px: mean error towards the tag's centre.
        systematic_px: rms error in the same picture without noise.
        noise_px: rms about each tag's mean over the realisations.  shape_px: the closed form with k = 1, no floor.
        nees: mean of e' C⁻¹ e / 8 with the fit's covariance C and the floor; 1 when C is right.
    """

    side_px: float
    incidence_deg: float
    tags: int
    missed: int
    rejected: int
    bias_px: tuple[float, float]
    shrink_px: float
    systematic_px: float
    noise_px: float
    shape_px: float
    nees: float


@dataclass(frozen=True, kw_only=True)
class NoiseCalibration:
    """The detector's noise: the closed form's two numbers and the evidence.

    Attributes:
        family: of the tags.
        ratios: (cells,) measured / predicted sigma per cell, systematic error and noise together.
    """

    family: str
    noise: CornerNoise
    cells: tuple[NoiseCell, ...]
    ratios: tuple[float, ...]
    warnings: tuple[str, ...]


def calibrate_study(study: Path, output: Path, progress: Progress = silent, workers: int = 2) -> str:
    """Calibrate the camera of a study, write the file that ``noise = "detector"`` uses, and say what was found.

    Raises:
        InputError: the study is not one.
        OSError: ``output`` cannot be written; said before anything is measured.
        EnvironmentProblem: rendering is not possible here.
    """
    task = load_task(study)
    demand_writable(output)
    family = task.scene.targets.family
    shoot = Shoot(seed=task.study.seed, supersample=task.study.validation.supersample)
    with worker_pool(workers) as executor:
        found = calibrate_noise(task.camera, shoot, family=family, executor=executor, progress=progress)
    write_calibration(output, found, task.camera, shoot)
    ratios = np.array(found.ratios)
    lines = [
        f"k = {found.noise.k:.3f}, floor = {found.noise.floor_px:.5f} px; measured / predicted sigma "
        f"{np.nanmin(ratios):.3f} to {np.nanmax(ratios):.3f}, median {np.nanmedian(ratios):.3f}",
        *found.warnings,
        f'{output}: use it with camera.noise = "detector" and camera.noise_file',
    ]
    return "\n".join(lines)


def calibrate_noise(
    camera: Camera, shoot: Shoot, *, family: str = "tag36h11", sides_px: Sequence[float] = SIDES_PX,
    incidences_deg: Sequence[float] = INCIDENCES_DEG, replicates: int = REPLICATES,
    executor: Executor | None = None, progress: Progress = silent,
) -> NoiseCalibration:  # fmt: skip
    """Measure the detector with a camera's blur and sensor.

    Args:
        camera: its blur, full well and read noise are used, not its geometry.  family: of the tags.

    Raises:
        EnvironmentProblem: rendering is not possible here.
        InputError: no tag is found anywhere on the grid.
    """
    count = FAMILIES[family].cells
    grid = [
        (side, incidence)
        for side in sides_px
        for incidence in incidences_deg
        if side * np.cos(np.radians(incidence)) / count >= SMALLEST_CELL_PX
    ]
    jobs = [(camera, shoot, family, side, incidence, replicates, index) for index, (side, incidence) in enumerate(grid)]
    results = list(each(_measure_cell, jobs, executor, "calibrate", progress))
    cells = [cell for cell, _, _ in results]
    usable = [cell for cell in cells if cell.tags >= 2 * replicates]
    if not usable:
        raise InputError("calibrate-noise: expected tags to be found on the grid, found none: too much blur or noise")
    k = float(np.exp(np.mean([np.log(cell.noise_px / cell.shape_px) for cell in usable])))
    noise = np.array([cell.noise_px for cell in usable])
    floor = _floor(noise, np.hypot(noise, [cell.systematic_px for cell in usable]))
    finished = [replace(cell, nees=_nees(errors, covariances, floor)) for cell, errors, covariances in results]
    measured = [np.hypot(cell.noise_px, cell.systematic_px) for cell in finished]
    predicted = [np.hypot(k * cell.shape_px, floor) for cell in finished]
    return NoiseCalibration(
        family=family,
        noise=CornerNoise(k=k, floor_px=floor, cells=count),
        cells=tuple(finished),
        ratios=tuple(float(a / b) for a, b in zip(measured, predicted, strict=True)),
        warnings=tuple(_warnings(finished)),
    )


def _floor(noise: Floats, total: Floats) -> float:
    """Return the floor (px) with which noise and floor are nearest, in ratio, to the total sigma.

    A mean of the systematic parts would be that of the small tags, where it does not matter, and spoil the large ones.
    """
    candidates = np.linspace(0.0, float(total.max()), 2001)
    ratio = np.log(np.hypot(noise, candidates[:, None]) / total)
    return float(candidates[np.square(ratio).sum(axis=1).argmin()])


def write_calibration(path: Path, found: NoiseCalibration, camera: Camera, shoot: Shoot) -> None:
    """Write a calibration (kind noise), which ``files.noise.read_corner_noise`` reads."""
    record = camera_record(camera)
    payload: dict[str, Any] = {
        "family": found.family,
        "k": found.noise.k,
        "floor_px": found.noise.floor_px,
        "camera": {name: record[name] for name in ("blur_px", "full_well_e", "read_noise_e")},
        "supersample": shoot.supersample,
        "renderer": shoot.renderer,
        "seed": shoot.seed,
        "cells": [
            {**asdict(cell), "measured_over_predicted": ratio}
            for cell, ratio in zip(found.cells, found.ratios, strict=True)
        ],
        "warnings": list(found.warnings),
    }
    write_json(path, "noise", payload)


def _measure_cell(job: tuple[Camera, Shoot, str, float, float, int, int]) -> tuple[NoiseCell, Floats, Floats]:
    """Render one size and incidence; return the cell, errors (k, 8) px and covariances (k, 8, 8) px²."""
    camera, shoot, family, side, incidence_deg, replicates, index = job
    random = np.random.default_rng([shoot.seed, 7, index])
    scene = _tag_field(random, family)
    bench = _bench_camera(camera, side)
    tilt = np.array([random.uniform(-np.pi, np.pi), np.pi / 2 - np.radians(incidence_deg)])
    distance = FOCAL_PX * TAG_SIZE_M / side
    pose = look_at(distance * sphere_directions(tilt), np.zeros(3), random.uniform(-np.pi, np.pi))
    truth = project(pose, scene.targets.points, bench.intrinsics)[0].reshape(-1, CORNERS_PER_TAG, 2)
    row_of_tag = {tag: row for row, tag in enumerate(scene.targets.ids.tolist())}
    light = Photographer(scene, bench, shoot).light(pose)
    clean = Photographer.expose(light, bench, replace(shoot, noise=False, bits=16), index)
    systematic = [
        tag.corners_px - truth[row_of_tag[tag.tag_id]]
        for tag in measure(clean, bench, scene.targets.family, TAG_SIZE_M, row_of_tag)
        if not tag.rejected
    ]
    errors, covariances, of_tag, missed, rejected = [], [], [], 0, 0
    for replicate in range(replicates):
        picture = Photographer.expose(light, bench, shoot, 1000 * index + replicate)
        found = measure(picture, bench, scene.targets.family, TAG_SIZE_M, row_of_tag)
        missed += len(row_of_tag) - len({tag.tag_id for tag in found})
        for tag in found:
            if tag.rejected:
                rejected += 1
                continue
            row = row_of_tag[tag.tag_id]
            errors.append((tag.corners_px - truth[row]).ravel())
            covariances.append(tag.covariance_px2)
            of_tag.append(row)
    e, c = np.reshape(errors, (-1, 8)), np.reshape(covariances, (-1, 8, 8))
    outward = truth - truth.mean(axis=1, keepdims=True)
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    inward = -np.einsum("kcx,kcx->kc", e.reshape(-1, 4, 2), outward[np.array(of_tag, dtype=np.int64)])
    plain = CornerNoise(k=1.0, floor_px=0.0, cells=scene.targets.cells)
    shape = corner_rms(replace(bench, corner_noise=plain), side, np.radians(incidence_deg))
    bias = e.reshape(-1, 2).mean(axis=0) if len(e) else np.full(2, np.nan)
    cell = NoiseCell(
        side_px=side, incidence_deg=incidence_deg, tags=len(e), missed=missed, rejected=rejected,
        bias_px=(float(bias[0]), float(bias[1])), shrink_px=float(inward.mean()) if len(e) else float("nan"),
        systematic_px=float(np.sqrt(np.mean(np.square(systematic)))) if systematic else float("nan"),
        noise_px=_noise(e, np.array(of_tag, dtype=np.int64)), shape_px=float(shape), nees=float("nan"),
    )  # fmt: skip
    return cell, e, c


def _noise(errors: Floats, of_tag: Any) -> float:
    """Return the rms (px) of errors (k, 8) of repeatedly measured tags (k,) about each tag's mean."""
    within, degrees = 0.0, 0
    for tag in np.unique(of_tag):
        group = errors[of_tag == tag]
        within += float(((group - group.mean(axis=0)) ** 2).sum())
        degrees += 8 * (len(group) - 1)
    return float(np.sqrt(within / degrees)) if degrees else float("nan")


def _nees(errors: Floats, covariances: Floats, floor_px: float) -> float:
    if not len(errors):
        return float("nan")
    solved = np.linalg.solve(covariances + floor_px**2 * np.eye(8), errors[..., None])[..., 0]
    return float(np.einsum("ki,ki->k", errors, solved).mean()) / 8


def _warnings(cells: Sequence[NoiseCell]) -> list[str]:
    """Return what a reader of the calibration must know."""
    found = []
    for cell in cells:
        where = f"side {cell.side_px:g} px at {cell.incidence_deg:g} deg"
        shown = cell.tags + cell.missed + cell.rejected
        if cell.missed or cell.rejected:
            found.append(f"{where}: {cell.missed} of {shown} tags not detected, {cell.rejected} rejected")
        if not NEES_BAND[0] <= cell.nees <= NEES_BAND[1]:
            found.append(f"{where}: NEES/8 {cell.nees:.2f}, expected {NEES_BAND[0]} to {NEES_BAND[1]}")
    return found


def _tag_field(random: np.random.Generator, family: str) -> Scene:
    """Return a plate with ACROSS x DOWN tags at z = 0, each turned at random about its normal."""
    pitch = 2.0 * TAG_SIZE_M  # the quiet zone's diagonal fits
    columns, rows = np.meshgrid(np.arange(ACROSS) - (ACROSS - 1) / 2, np.arange(DOWN) - (DOWN - 1) / 2)
    centres = np.stack([columns.ravel(), rows.ravel(), np.zeros(columns.size)], axis=1) * pitch
    turn = random.uniform(-np.pi, np.pi, len(centres))
    targets = Targets(
        ids=random.choice(FAMILIES[family].ids, len(centres), replace=False), centres=centres,
        normals=np.tile([0.0, 0.0, 1.0], (len(centres), 1)),
        x_axes=np.stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))], axis=1), size_m=TAG_SIZE_M, family=family,
    )  # fmt: skip
    half = 0.55 * pitch * np.array([ACROSS, DOWN])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    part = Part(vertices=np.column_stack([corners, np.zeros(4)]), faces=np.array([[0, 1, 2], [0, 2, 3]]))
    return Scene(part=part, targets=targets)


def _bench_camera(camera: Camera, side_px: float) -> Camera:
    """Return a camera with the given one's blur and sensor that just holds the field of tags."""
    size = int(np.ceil(2.0 * side_px * 1.15 * float(np.hypot(ACROSS, DOWN)) + 40))
    return replace(
        camera, width_px=size, height_px=size, focal_px=np.full(2, FOCAL_PX), distortion=np.zeros(4),
        principal_point_px=0.5 * (size - 1) + np.array([0.3, -0.2]), corner_noise=None,
        pixel_m=None, f_number=None, focus_m=None,
    )  # fmt: skip
