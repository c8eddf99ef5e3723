"""Measures what the imaging chain can and cannot do; writes results.json and the tables of README.md.

    python validation/imaging/run.py [pipeline] [mismatch] [throughput] [detectors] [false_ids] [prediction]

Without a name everything is measured (some ten minutes on two cores). The pictures share no
sampling or blur code with the fit.
"""

import json
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from netdesign.calibrate import calibrate_noise
from netdesign.files.noise import read_corner_noise
from netdesign.files.parts import load_part, load_targets
from netdesign.files.store import plain
from netdesign.imageset import measure_images, render_images, worker_pool
from netdesign.imaging.detect import detect
from netdesign.imaging.measure import Gates, measure
from netdesign.imaging.optics import expose, noise_generator
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.imaging.pictures import linear
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.model.camera import Camera
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.model.scene import Part, Scene, Targets
from netdesign.model.task import VisibilityLimits
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.visibility import sightings

HERE = Path(__file__).parent
DATASETS = HERE.parents[1] / "datasets"
CAMERA = Camera(
    width_px=1600, height_px=1200, focal_px=np.array([2400.0, 2400.0]), principal_point_px=np.array([799.3, 599.8]),
    distortion=np.array([-0.12, 0.03, 0.0005, -0.0005]),
)  # fmt: skip
LIMITS = VisibilityLimits(
    max_incidence=np.radians(65), min_tag_px=20, border_px=10, min_rays=3, min_points_per_image=8, occlusion=True
)
FINE = 3  # hi-res factor of the mismatch pictures


def polyhedron():
    """The polyhedron of datasets/."""
    part = load_part(DATASETS / "parts" / "polyhedron.stl", "mm", np.eye(4))
    return Scene(
        part=part, targets=load_targets(DATASETS / "parts" / "polyhedron_tags.csv", "tag36h11", 0.02, np.eye(4))
    )


def stations(count, seed, near, far):
    """Random views with random roll."""
    random = np.random.default_rng(seed)
    viewpoints = np.column_stack([random.uniform(-np.pi, np.pi, count), random.uniform(0.15, 1.4, count)])
    aim = random.normal(scale=0.01, size=(count, 3))
    position = aim + random.uniform(near, far, count)[:, None] * sphere_directions(viewpoints)
    return look_at(position, aim, random.uniform(-np.pi, np.pi, count))


def compare(measured, scene, camera, pose, visible, floor_px):
    """Return errors (k, 8), NEES (k,), rejected errors, missed and false counts of one picture."""
    truth = project(pose, scene.targets.points, camera.intrinsics)[0].reshape(-1, 4, 2)
    row = {tag: index for index, tag in enumerate(scene.targets.ids.tolist())}
    errors, nees, rejected = [], [], []
    false = sum(tag.tag_id not in row and not tag.rejected for tag in measured)
    for tag in measured:
        if tag.tag_id not in row or not visible[row[tag.tag_id]]:
            continue
        error = (tag.corners_px - truth[row[tag.tag_id]]).ravel()
        if tag.rejected:
            rejected.append(error)
            continue
        covariance = tag.covariance_px2 + floor_px**2 * np.eye(8)
        errors.append(error)
        nees.append(error @ np.linalg.solve(covariance, error) / 8)
    found = {tag.tag_id for tag in measured}
    missed = sum(bool(visible[index]) and tag not in found for tag, index in row.items())
    return errors, nees, rejected, missed, false


def pipeline():
    """The whole chain on the polyhedron, random views, default noise."""
    scene, floor = polyhedron(), read_corner_noise(None).floor_px
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


def disk(radius):
    """A disk, in fine pixels."""
    size = int(np.ceil(radius * FINE)) + 1
    y, x = np.mgrid[-size : size + 1, -size : size + 1]
    kernel = np.clip(radius * FINE + 0.5 - np.hypot(x, y), 0, 1)
    return kernel / kernel.sum()


def bell(along, across, angle=0.5):
    """A Gaussian with two sigmas in px, turned, in fine pixels."""
    size = int(np.ceil(4 * max(along, across) * FINE))
    y, x = np.mgrid[-size : size + 1, -size : size + 1] / FINE
    u, v = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    kernel = np.exp(-0.5 * ((u / along) ** 2 + (v / across) ** 2))
    return kernel / kernel.sum()


def streak(length, angle=0.5):
    """A line of ``length`` px, in fine pixels."""
    kernel = np.zeros((8 * FINE + 1, 8 * FINE + 1))
    for step in np.linspace(-0.5, 0.5, 401):
        x, y = 4 * FINE + step * length * FINE * np.cos(angle), 4 * FINE + step * length * FINE * np.sin(angle)
        i, j, a, b = int(y), int(x), y - int(y), x - int(x)
        kernel[i : i + 2, j : j + 2] += np.outer([1 - a, a], [1 - b, b])
    return kernel / kernel.sum()


def covered(picture, truth, random):
    """Every second tag loses a corner of a cell or two to a bright patch."""
    hidden = picture.copy()
    for corners in truth[::2]:
        side = np.linalg.norm(corners[1] - corners[0])
        x, y = corners.mean(axis=0) + random.uniform(-0.35, 0.35, 2) * side
        half = side * random.uniform(0.05, 0.12)
        hidden[max(int(y - half), 0) : int(y + half) + 1, max(int(x - half), 0) : int(x + half) + 1] = 200
    return hidden


def mismatch():
    """What a wrong image model does to the corners, and whether the gates notice."""
    centres = [[x, y, 0.0] for x in np.arange(-3, 4) * 0.036 for y in np.arange(-2, 3) * 0.036]
    count = len(centres)
    random = np.random.default_rng(8)
    turn = random.uniform(-np.pi, np.pi, count)
    targets = Targets(
        ids=np.arange(count), centres=centres, normals=np.tile([0.0, 0, 1], (count, 1)),
        x_axes=np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)]), size_m=0.02,
    )  # fmt: skip
    board = np.array([[-0.14, -0.1, 0], [0.14, -0.1, 0], [0.14, 0.1, 0], [-0.14, 0.1, 0]])
    scene = Scene(part=Part(vertices=board, faces=np.array([[0, 1, 2], [0, 2, 3]])), targets=targets)
    camera = replace(
        CAMERA, width_px=1000, height_px=760, focal_px=np.array([1500.0, 1500.0]),
        principal_point_px=np.array([499.5, 379.5]), distortion=np.array([-0.18, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    pose = look_at(0.5 * sphere_directions(np.radians([35.0, 62.0])), np.zeros(3), 0.37)
    fine = replace(
        camera, width_px=FINE * 1000, height_px=FINE * 760, focal_px=FINE * camera.focal_px, blur_px=0.6,
        principal_point_px=FINE * (camera.principal_point_px + 0.5) - 0.5,
    )  # fmt: skip
    sharp = ReferenceRenderer(scene, fine).render(inverse(pose))
    truth = project(pose, targets.points, camera.intrinsics)[0].reshape(-1, 4, 2)
    y, x = np.mgrid[0:760, 0:1000]
    shine = np.exp(-((x - 420) ** 2 + (y - 330) ** 2) / (2 * 160.0**2)).astype(np.float32)
    # sharp has 0.2 px of blur; the base PSF makes it 0.7 px.
    base = np.sqrt(0.7**2 - 0.2**2)

    def light(kernel):
        blurred = cv2.filter2D(sharp, -1, kernel.astype(np.float32), borderType=cv2.BORDER_REPLICATE)
        return blurred.reshape(760, FINE, 1000, FINE).mean(axis=(1, 3))

    def shoot(picture):
        return expose(picture.astype(np.float32), camera, noise_generator(3, 0))

    plain_light = light(bell(base, base))
    photo = shoot(plain_light)
    bent = np.rint(255 * (photo / 255.0) ** (1 / 2.2)).astype(np.uint8)
    wrong = replace(camera, distortion=0.8 * camera.distortion)
    jpeg = {q: cv2.imdecode(cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, q])[1], 0) for q in (95, 85)}
    cases = {
        "matched": (photo, camera),
        "gamma 2.2 not undone": (bent, camera),
        "gamma 2.2 undone": (linear(bent, 2.2), camera),
        "defocus, disk r = 1.5 px": (shoot(light(disk(1.5))), camera),
        "defocus, disk r = 3 px": (shoot(light(disk(3.0))), camera),
        "anisotropic blur 1.0 x 0.5 px": (shoot(light(bell(1.0, 0.5))), camera),
        "motion blur 2 px": (shoot(light(cv2.filter2D(bell(base, base), -1, streak(2.0)))), camera),
        "clipped whites, exposure x 1.25": (shoot(1.25 * plain_light), camera),
        "light 60 to 100 % across": (shoot(plain_light * (0.6 + 0.4 * x / 999)), camera),
        "specular spot, + 40 %": (shoot(plain_light + 0.4 * shine * plain_light), camera),
        "specular spot, + 0.25 added": (shoot(0.7 * plain_light + 0.25 * shine), camera),
        "JPEG quality 95": (jpeg[95], camera),
        "JPEG quality 85": (jpeg[85], camera),
        "distortion known to 20 %": (photo, wrong),
        "tags partly covered": (covered(photo, truth, np.random.default_rng(5)), camera),
        "full well 3 x wrong": (photo, replace(camera, full_well_e=4500.0)),
    }
    rows = []
    outward = truth - truth.mean(axis=1, keepdims=True)
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    for name, (picture, known) in cases.items():
        for gates in (Gates(), Gates(own_noise=True)):
            tags = measure(picture, known, "tag36h11", 0.02, range(count), gates, read_corner_noise(None).floor_px)
            good = [tag for tag in tags if not tag.rejected]
            error = np.reshape([tag.corners_px - truth[tag.tag_id] for tag in good], (-1, 4, 2))
            radial = [np.einsum("cx,cx->c", tag.corners_px - truth[tag.tag_id], outward[tag.tag_id]) for tag in good]
            nees = [
                e.ravel() @ np.linalg.solve(t.covariance_px2, e.ravel()) / 8 for e, t in zip(error, good, strict=True)
            ]
            every = np.reshape([t.corners_px - truth[t.tag_id] for t in tags if np.isfinite(t.chi2_per_dof)], (-1, 8))
            rows.append({
                "case": name, "gate": "own noise" if gates.own_noise else "sensor noise", "tags": count,
                "found": len(tags), "accepted": len(good),
                "rms_accepted_px": float(np.sqrt((error**2).mean())) if len(good) else None,
                "worst_accepted_px": float(np.abs(error).max()) if len(good) else None,
                "outward_px": float(np.mean(radial)) if good else None,
                "nees_per_8": float(np.mean(nees)) if good else None,
                "rms_all_px": float(np.sqrt((every**2).mean())) if len(every) else None,
            })  # fmt: skip
    return rows


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
    shipped, rows = read_corner_noise(None), []
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


def table(rows):
    """Return the mismatch rows as a Markdown table."""
    titles = (
        "what is wrong",
        "gate",
        "accepted of found",
        "rms px",
        "worst px",
        "outward px",
        "NEES/8",
        "rms of all px",
    )
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    keys = ("rms_accepted_px", "worst_accepted_px", "outward_px", "nees_per_8", "rms_all_px")
    for row in rows:
        cells = ["-" if row[key] is None else f"{row[key]:.4f}" for key in keys]
        lines.append(f"| {row['case']} | {row['gate']} | {row['accepted']} of {row['found']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main():
    """Measure what is asked for and renew the files."""
    path = HERE / "results.json"
    results = json.loads(path.read_text()) if path.is_file() else {}
    measures = {
        "pipeline": pipeline, "mismatch": mismatch, "throughput": throughput, "detectors": detectors,
        "false_ids": false_ids, "prediction": prediction,
    }  # fmt: skip
    for name in sys.argv[1:] or measures:
        results[name] = plain(measures[name]())
        print(name, json.dumps(results[name], indent=1))
        path.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    readme = HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    begin, end = "<!-- mismatch -->\n", "<!-- end -->\n"
    head, rest = text.split(begin)
    readme.write_text(head + begin + table(results.get("mismatch", [])) + end + rest.split(end)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
