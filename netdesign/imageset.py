"""Synthetic image sets with their truth, and the measurement of image sets.

    with worker_pool(2) as executor:
        paths = render_images(scene, camera, limits, world_from_cam, folder, Shoot(seed=1), executor=executor)
        measured = measure_images(paths, camera, scene.targets, executor=executor)

Pictures do not depend on the number of workers or on their order. A folder is finished where it was left: its
truth.json says what it is, and every picture appears whole or not at all.
"""

import contextlib
import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InputError
from netdesign.files.noise import read_corner_noise
from netdesign.files.store import write_bytes
from netdesign.imaging.measure import Gates, TagMeasurement, measure
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.imaging.pictures import linear, png_bytes, read_picture
from netdesign.imaging.render import check_width
from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.network import Observations
from netdesign.model.progress import Progress, silent
from netdesign.model.scene import CORNERS_PER_TAG, Scene, Targets
from netdesign.model.task import VisibilityLimits
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.visibility import sightings
from netdesign.truth import image_name, write_truth


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[Executor | None]:
    """Give an executor of spawned processes, or None (work in this process) for fewer than two workers.

    A process that holds an OpenGL context must not be forked, hence "spawn". A worker needs up to 1 GB.
    """
    if workers < 2:
        yield None
        return
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def render_images(
    scene: Scene, camera: Camera, limits: VisibilityLimits, world_from_cam: Floats, out: Path, shoot: Shoot, *,
    executor: Executor | None = None, progress: Progress = silent, study_sha256: str | None = None,
    drawn: Sequence[Scene] | None = None,
) -> list[Path]:  # fmt: skip
    """Render an image set: images/*.png, truth.json, corners.csv and a COLMAP text model.

    The truth lists the corners of tags that are seen by the definition of ``limits``.

    Args:
        world_from_cam: (n, 4, 4) m, the exact poses.
        drawn: what stands before the camera, per image, if it differs from the truth (wrong ids, foreign tags).

    Returns:
        The n image paths.

    Raises:
        InputError: pictures too wide; ``out`` cannot be written, or holds pictures that are no image set of ours.
        EnvironmentProblem: the renderer's system libraries are missing.
    """
    if shoot.renderer == "pyrender":
        check_width(camera, shoot.supersample)
    _check_folder(out)
    visible = sightings(scene, camera, world_from_cam, limits).visible
    xy_px, _ = project(world_from_cam[:, None], scene.targets.points[None], camera.intrinsics)
    paths = [out / "images" / image_name(index) for index in range(len(world_from_cam))]
    shown = drawn or [scene] * len(paths)
    write_truth(scene, camera, world_from_cam, visible, xy_px, out, shoot, shown, study_sha256)
    missing = [index for index, path in enumerate(paths) if not path.is_file()]
    sessions = {id(item): pickle.dumps((item, camera, shoot)) for item in shown}
    jobs = [(sessions[id(shown[index])], index, world_from_cam[index], paths[index]) for index in missing]
    for _ in each(_render_one, jobs, executor, "render", progress):
        pass
    return paths


def _check_folder(out: Path) -> None:
    """Refuse a folder that cannot be made, or whose pictures would be lost.

    Raises:
        InputError: with what was found.
    """
    if not (out / "truth.json").is_file() and any((out / "images").glob("*")):
        raise InputError(
            f"{out}: expected an empty folder or an image set of netdesign, found pictures without truth.json"
        )
    try:
        (out / "images").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder that can be written, found: {error.strerror}") from None
    if not os.access(out, os.W_OK):
        raise InputError(f"{out}: expected a folder that can be written, found one that cannot")


def measure_images(
    paths: Sequence[Path], camera: Camera, targets: Targets, *, gates: Gates | None = None,
    floor_px: float | None = None, gamma: float = 1.0, executor: Executor | None = None, progress: Progress = silent,
) -> list[list[TagMeasurement]]:  # fmt: skip
    """Detect and fit the tags of every picture; look at ``rejected`` before use.

    Args:
        floor_px: systematic error of the method added to every coordinate's variance; None takes the camera's
            calibrated noise, else the shipped one.
        gamma: exponent that makes the pictures linear in light (``imaging.tone``).

    Raises:
        InputError: a picture cannot be read or is not of the camera's size.
    """
    if floor_px is None:
        floor_px = (camera.corner_noise or read_corner_noise(None, targets.family)).floor_px
    jobs = [(path, camera, targets, gates, floor_px, gamma) for path in paths]
    return list(each(_measure_one, jobs, executor, "measure", progress))


def observations_of(
    measured: Sequence[Sequence[TagMeasurement]], targets: Targets
) -> tuple[Observations, list[Floats], list[str]]:
    """Return what may be used, as observations.

    Args:
        measured: per image, from ``measure_images``.

    Returns:
        Observations, tag by tag with four rows each; the (8, 8) px² covariance of each of those tags in that order;
        and for every rejected tag "image i, tag t: reason".
    """
    row_of_tag = {tag: row for row, tag in enumerate(targets.ids.tolist())}
    image: list[int] = []
    point: list[int] = []
    xy_px: list[Floats] = []
    blocks: list[Floats] = []
    covariances: list[Floats] = []
    rejected = []
    for index, tags in enumerate(measured):
        for tag in tags:
            reason = tag.rejected or ("" if tag.tag_id in row_of_tag else "not a tag of the part")
            if reason:
                rejected.append(f"image {index}, tag {tag.tag_id}: {reason}")
                continue
            first = CORNERS_PER_TAG * row_of_tag[tag.tag_id]
            image += [index] * CORNERS_PER_TAG
            point += range(first, first + CORNERS_PER_TAG)
            xy_px += list(tag.corners_px)
            blocks += [tag.covariance_px2[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(CORNERS_PER_TAG)]
            covariances.append(tag.covariance_px2)
    observations = Observations(
        image=np.array(image, np.int64), point=np.array(point, np.int64), xy_px=np.reshape(xy_px, (-1, 2)),
        covariance=np.reshape(blocks, (-1, 2, 2)),
    )  # fmt: skip
    return observations, covariances, rejected


@lru_cache(maxsize=1)
def _session(pickled: bytes) -> Photographer:
    """Keep one prepared scene per process: consecutive pictures share it."""
    scene, camera, shoot = pickle.loads(pickled)
    return Photographer(scene, camera, shoot)


def _render_one(job: tuple[bytes, int, Floats, Path]) -> None:
    session, index, world_from_cam, path = job
    write_bytes(path, png_bytes(_session(session).take(index, world_from_cam)))


def _measure_one(job: tuple[Path, Camera, Targets, Gates | None, float, float]) -> list[TagMeasurement]:
    path, camera, targets, gates, floor_px, gamma = job
    ids = set(targets.ids.tolist())
    picture = read_picture(path, camera)
    straight = picture if gamma == 1.0 else linear(picture, gamma)
    return measure(straight, camera, targets.family, targets.size_m, ids, gates, floor_px)


def each(
    work: Callable[[Any], Any], jobs: Sequence[Any], executor: Executor | None, stage: str, progress: Progress
) -> Iterator[Any]:
    """Yield the results of ``work`` in the order of ``jobs``, done here or by the executor's processes."""
    futures: list[Future[Any]] = [] if executor is None else [executor.submit(work, job) for job in jobs]
    for done, job in enumerate(jobs):
        yield work(job) if executor is None else futures[done].result()
        progress(stage, done + 1, len(jobs))
