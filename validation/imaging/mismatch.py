"""Pictures that break one assumption of the fit each: what bias results, and do the gates notice?"""

from dataclasses import replace

import cv2
import numpy as np

from netdesign.files.noise import read_corner_noise
from netdesign.imaging.measure import Gates, measure
from netdesign.imaging.optics import expose, noise_generator
from netdesign.imaging.pictures import linear
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.model.scene import Part, Scene, Targets
from netdesign.photogrammetry.collinearity import project
from validation.imaging.scenes import CAMERA

FINE = 3  # hi-res factor of the pictures


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
    floor = read_corner_noise(None, "tag36h11").floor_px
    for name, (picture, known) in cases.items():
        for gates in (Gates(), Gates(own_noise=True)):
            tags = measure(picture, known, "tag36h11", 0.02, range(count), gates, floor)
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
