"""The whole chain from picture to corner: what is found, how well, how fast."""

import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from netdesign.calibrate import calibrate_noise
from netdesign.files.noise import read_corner_noise
from netdesign.imageset import measure_images, render_images, worker_pool
from netdesign.imaging.detect import detect
from netdesign.imaging.measure import measure
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.scene import Part, Scene, Targets
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.visibility import sightings
from validation.imaging.scenes import CAMERA, LIMITS, compare, polyhedron, stations


def pipeline():
    """The whole chain on the polyhedron, random views, default noise."""
    scene, floor = polyhedron(), read_corner_noise(None, "tag36h11").floor_px
    poses = stations(14, 21, 0.45, 0.75)
    visible = sightings(scene, CAMERA, poses, LIMITS).visible_tags
    photographer = Photographer(scene, CAMERA, Shoot(seed=4, supersample=4))
    errors, nees, rejected, missed, false = [], [], [], 0, 0
    for index, pose in enumerate(poses):
        measured = measure(photographer.take(index, pose), CAMERA, "tag36h11", 0.02)
        e, n, r, m, f = compare(measured, scene, CAMERA, pose, visible[index], floor)
        errors, nees, rejected, missed, false = errors + e, nees + n, rejected + r, missed + m, false + f
    errors = np.array(errors)
    return {
        "tags_visible": int(visible.sum()), "tags_missed": missed, "tags_rejected": len(rejected), "false_ids": false,
        "rms_px": float(np.sqrt((errors**2).mean())), "mean_px": errors.reshape(-1, 2).mean(axis=0),
        "nees_per_8": float(np.mean(nees)),
    }  # fmt: skip


def throughput():
    """Two workers: 1600 x 1200, supersampling 4, about 25 tags of 120 px."""
    centres = [[x, y, 0.0] for x in np.arange(-2, 3) * 0.05 for y in np.arange(-2, 3) * 0.04]
    targets = Targets(
        ids=np.arange(25), centres=centres, normals=np.tile([0.0, 0, 1], (25, 1)), x_axes=np.tile([1.0, 0, 0], (25, 1)),
        size_m=0.026,
    )  # fmt: skip
    board = np.array([[-0.14, -0.12, 0], [0.14, -0.12, 0], [0.14, 0.12, 0], [-0.14, 0.12, 0]])
    scene = Scene(part=Part(vertices=board, faces=np.array([[0, 1, 2], [0, 2, 3]])), targets=targets)
    random = np.random.default_rng(3)
    count = 8
    viewpoints = np.column_stack([random.uniform(-3, 3, count), random.uniform(1.1, 1.4, count)])
    poses = look_at(0.52 * sphere_directions(viewpoints), np.zeros(3), random.uniform(-0.3, 0.3, count))
    usage = []
    with tempfile.TemporaryDirectory() as folder, worker_pool(1) as executor:
        for part in (poses[:2], poses):  # the first round pays for imports and compilation
            before = time.process_time()
            out = Path(folder) / str(len(part))
            paths = render_images(scene, CAMERA, LIMITS, part, out, Shoot(), executor=executor)
            middle = time.process_time()
            tags = measure_images(paths, CAMERA, targets, executor=executor)
            usage.append((middle - before, time.process_time() - middle, len(part)))
    render_s, measure_s, images = usage[-1]
    return {
        "images": images, "tags_per_image": float(np.mean([len(item) for item in tags])),
        "cell_px": float(np.mean([tag.cell_px for item in tags for tag in item])),
        "cpu_s_per_image_render": render_s / images, "cpu_s_per_image_measure": measure_s / images,
        "images_per_minute_two_cores_from_cpu": 120 * images / (render_s + measure_s),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }  # fmt: skip


def detectors():
    """OpenCV's and pupil's own corners on our pictures: their offsets, not ours."""
    from pupil_apriltags import Detector

    scene = polyhedron()
    poses = stations(4, 5, 0.45, 0.7)
    visible = sightings(scene, CAMERA, poses, replace(LIMITS, min_tag_px=25)).visible_tags
    photographer, pupil = Photographer(scene, CAMERA, Shoot(seed=9, supersample=4)), Detector(quad_decimate=1.0)
    Detector.__del__ = lambda self: None  # it frees its families twice
    found = {"opencv": [], "pupil": []}
    same = True
    for index, pose in enumerate(poses):
        picture = photographer.take(index, pose)
        truth = project(pose, scene.targets.points, CAMERA.intrinsics)[0].reshape(-1, 4, 2)
        # pupil counts from the picture's corner and lists corners from the lower left against our order.
        theirs = {int(tag.tag_id): np.roll(tag.corners[::-1], 2, 0) - 0.5 for tag in pupil.detect(picture)}
        ours = {tag.tag_id: tag.corners_px for tag in detect(picture, "tag36h11")}
        for row in np.flatnonzero(visible[index]):
            tag = int(scene.targets.ids[row])
            same &= (tag in theirs) == (tag in ours)
            for name, corners in (("opencv", ours), ("pupil", theirs)):
                if tag in corners:
                    found[name].append(corners[tag] - truth[row])
    return {"same_ids": bool(same), "tags_visible": int(visible.sum())} | {
        name: {"tags": len(e), "rms_px": float(np.sqrt(np.mean(np.square(e)))), "mean_px": np.mean(e, axis=(0, 1))}
        for name, e in found.items()
    }


def false_ids():
    """Ids that nobody put there, in 2000 pictures of tags without a list of the ids that may occur."""
    scene = polyhedron()
    poses = stations(10, 77, 0.45, 0.7)
    visible = sightings(scene, CAMERA, poses, LIMITS).visible_tags
    photographer, known = Photographer(scene, CAMERA, Shoot(seed=13, supersample=2)), set(scene.targets.ids.tolist())
    pictures, found, false = 0, 0, 0
    for index, pose in enumerate(poses):
        light = photographer.light(pose)
        for repeat in range(15):
            seen = detect(photographer.expose(light, CAMERA, photographer.shoot, 100 * index + repeat), "tag36h11")
            pictures += int(visible[index].sum())
            found += len(seen)
            false += sum(tag.tag_id not in known for tag in seen)
    return {"tag_pictures": pictures, "recognised": found, "false_ids": false}


def prediction():
    """Measured corner sigma over the closed form's with the shipped k and floor, for other blurs and sensors."""
    shipped, rows = read_corner_noise(None, "tag36h11"), []
    with worker_pool(2) as executor:
        for blur, well in ((0.5, 1500.0), (1.0, 1500.0), (1.3, 1500.0), (0.7, 600.0), (0.7, 6000.0)):
            camera = replace(CAMERA, blur_px=blur, full_well_e=well)
            found = calibrate_noise(
                camera, Shoot(seed=17), sides_px=(25.0, 50.0, 100.0), incidences_deg=(0.0, 35.0, 60.0), replicates=5,
                executor=executor,
            )  # fmt: skip
            for cell in found.cells:
                predicted = np.hypot(shipped.k * cell.shape_px, shipped.floor_px)
                rows.append({
                    "blur_px": blur, "full_well_e": well, "side_px": cell.side_px, "incidence_deg": cell.incidence_deg,
                    "tags": cell.tags, "missed": cell.missed, "rejected": cell.rejected, "nees_per_8": cell.nees,
                    "measured_over_predicted": float(np.hypot(cell.noise_px, cell.systematic_px) / predicted),
                })  # fmt: skip
    ratios = np.array([row["measured_over_predicted"] for row in rows if row["tags"] >= 20])
    return {
        "cells": rows, "judged": len(ratios), "lowest": float(ratios.min()), "highest": float(ratios.max()),
        "median_deviation": float(np.median(np.abs(ratios - 1))),
    }  # fmt: skip
