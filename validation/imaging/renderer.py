"""The GL renderer against the reference renderer, without noise: where do the corners come to lie?

Both draw the same views; the same fit measures both. They share the scene and the blur, nothing else. COLMAP's own
reading, triangulation and adjustment of an image set and the machine without EGL are tests (tests/test_imageset.py,
tests/test_render.py).
"""

from dataclasses import replace

import numpy as np

from netdesign.imaging.fit import fit_tag
from netdesign.imaging.geometry import tag_quads
from netdesign.imaging.optics import expose
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.imaging.render import Renderer
from netdesign.imaging.tags import cells
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.model.scene import Part, Scene, Targets
from netdesign.photogrammetry.collinearity import project
from validation.imaging.scenes import CAMERA

SIDES_PX = (30, 60, 120, 200)
TAG_M = 0.02
BANDS_DEG = ((0, 45), (45, 65))
VIEWS = 12  # of each size and camera
BORDER_PX = 12


def plate():
    """A plate of 5 x 5 tags, each turned by its own angle."""
    steps = np.arange(-2, 3) * 0.036  # quiet zones must not overlap, whatever the turn
    random = np.random.default_rng(2)
    turn = random.uniform(-np.pi, np.pi, 25)
    targets = Targets(
        ids=np.arange(25), centres=[[x, y, 0.0] for x in steps for y in steps], normals=np.tile([0.0, 0, 1], (25, 1)),
        x_axes=np.column_stack([np.cos(turn), np.sin(turn), np.zeros(25)]), size_m=TAG_M,
    )  # fmt: skip
    board = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    return Scene(part=Part(vertices=board, faces=np.array([[0, 1, 2], [0, 2, 3]])), targets=targets)


def corners(picture, pose, scene, camera):
    """Return {tag: (4, 2) px} of the tags of a picture without noise that are wholly inside it."""
    found = {}
    for quad in tag_quads(scene.targets, camera, inverse(pose)):
        truth = project(pose, scene.targets.points.reshape(-1, 4, 3)[quad.tag], camera.intrinsics)[0]
        room = np.array([camera.width_px, camera.height_px]) - BORDER_PX
        if (truth > BORDER_PX).all() and (truth < room).all():
            pattern = cells("tag36h11", int(scene.targets.ids[quad.tag]))
            fit = fit_tag(picture, pattern, truth + 0.2, camera.intrinsics, 65535 / 1500, 1e6)
            if fit.converged:
                found[quad.tag] = fit.corners_px, truth, np.degrees(np.arccos(quad.incidence_cos))
    return found


def renderer():
    """Return for each camera, size and range of incidence the rms and mean of GL minus reference, and of each."""
    scene, rows = plate(), []
    small = replace(
        CAMERA, width_px=1000, height_px=760, principal_point_px=np.array([499.3, 379.8]),
        focal_px=np.array([1500.0, 1500.0]),
    )  # fmt: skip
    for name, camera in (("pinhole", replace(small, distortion=np.zeros(4))), ("distorted", small)):
        gl, reference = Renderer(scene, camera, 4), ReferenceRenderer(scene, camera)
        for side in SIDES_PX:
            random = np.random.default_rng(side)
            low = np.where(np.arange(VIEWS) % 2, np.radians(27), np.radians(48))
            viewpoints = np.column_stack(
                [random.uniform(-np.pi, np.pi, VIEWS), low + np.radians(15) * random.random(VIEWS)]
            )
            distance = small.focal_px[0] * TAG_M / side
            aim = np.column_stack([random.uniform(-0.05, 0.05, (VIEWS, 2)), np.zeros(VIEWS)])
            poses = look_at(aim + distance * sphere_directions(viewpoints), aim, random.uniform(-np.pi, np.pi, VIEWS))
            pairs = []
            for pose in poses:
                ours, theirs = (
                    corners(expose(one.render(inverse(pose)), camera, None, 16), pose, scene, camera)
                    for one in (gl, reference)
                )
                pairs += [(*ours[tag], theirs[tag][0]) for tag in ours if tag in theirs]
            for low_deg, high_deg in BANDS_DEG:
                of_band = [(a, b, t) for a, t, incidence, b in pairs if low_deg <= incidence < high_deg]
                if len(of_band) < 5:
                    continue
                a, b, t = (np.array(part) for part in zip(*of_band, strict=True))
                rows.append({
                    "camera": name, "side_px": side, "incidence_deg": [low_deg, high_deg], "tags": len(a),
                    "rms_px": float(np.sqrt(((a - b) ** 2).mean())), "mean_px": (a - b).mean(axis=(0, 1)),
                    "rms_gl_px": float(np.sqrt(((a - t) ** 2).mean())),
                    "rms_reference_px": float(np.sqrt(((b - t) ** 2).mean())),
                })  # fmt: skip
        del gl
    return rows
