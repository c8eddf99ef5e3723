"""What a renderer draws, in the camera frame: tag quads and part faces with lens distortion in their vertices.

A vertex (X, Y, Z) of the camera frame becomes (x_d Z, y_d Z, Z), x_d and y_d its distorted normalised coordinates:
a pinhole renderer then draws the distorted picture. Straight edges between vertices replace curved ones, so large
faces are divided first. All in float64; the renderer rounds to float32 at the end.
"""

from dataclasses import dataclass

import numpy as np

from netdesign.imaging.looks import Appearance
from netdesign.imaging.tags import QUIET_CELLS
from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.camera import Camera
from netdesign.model.frames import inverse, transform
from netdesign.model.scene import Part, Targets

TAG_STEP_PX = 6.0  # longest edge of a tag's sub-quads under distortion: 0.002 px of a curved edge is left
FACE_STEP_PX = 30.0  # of a part's faces, where only the depth order and the silhouette matter
# Part faces lie this share of their distance behind the tags on them: same picture, no fight for the depth buffer.
RECESS = 4e-4


@dataclass(frozen=True, kw_only=True)
class TagQuad:
    """One visible tag with its quiet zone.

    Attributes:
        tag: index into the targets.  vertices: (k, 3) m, camera frame, distorted.
        uv: (k, 2) in [0, 1] over the quiet zone's square, u right, v up.  faces: (t, 3), seen counter-clockwise.
        cell_px: largest size of a cell in the picture.  incidence_cos: at the tag's centre.
    """

    tag: int
    vertices: Floats
    uv: Floats
    faces: Ints
    cell_px: float
    incidence_cos: float


def monotonic_radius(distortion: Floats) -> float:
    """Return the normalised radius up to which the distorted radius r (1 + k1 r² + k2 r⁴) grows; inf for ever."""
    k1, k2 = float(distortion[0]), float(distortion[1])
    roots = np.roots([5 * k2, 3 * k1, 1.0]) if k2 else np.array([-1 / (3 * k1)] if k1 else [])
    squares = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
    return float(np.sqrt(min(squares))) if squares else float("inf")


def distorted_vertices(in_camera: Floats, distortion: Floats) -> Floats:
    """Return (…, 3) points that a pinhole camera sees where the lens shows the points (…, 3) of the camera frame.

    Directions beyond ``monotonic_radius``, where the polynomial folds back into the picture, are held at that radius.
    """
    if not distortion.any():
        return in_camera
    depth = in_camera[..., 2:]
    ideal = in_camera[..., :2] / depth
    limit = monotonic_radius(distortion)
    if np.isfinite(limit):
        radius = np.linalg.norm(ideal, axis=-1, keepdims=True)
        ideal = ideal * np.minimum(1.0, limit / np.maximum(radius, 1e-12))
    x, y = ideal[..., 0], ideal[..., 1]
    k1, k2, p1, p2 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + k2 * r2)
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.concatenate([np.stack([bent_x, bent_y], axis=-1) * depth, depth], axis=-1)


def through_the_lens(world_from_cam: Floats, offset_m: Floats, focus_m: float) -> Floats:
    """Return the (4, 4) map from the world to what one point of the lens sees, as a camera frame.

    A ray through the point (dx, dy) of the lens meets the ray through its centre at the focus distance F:
    X' = X + dx (Z/F - 1), and Y likewise. Averaging pictures over the lens gives the depth of field.

    Args:
        offset_m: (2,) of the lens point in camera axes.
    """
    shear = np.eye(4)
    shear[:2, 2] = offset_m / focus_m
    shear[:2, 3] = -offset_m
    return shear @ inverse(world_from_cam)


def tag_quads(targets: Targets, camera: Camera, cam_from_world: Floats) -> list[TagQuad]:
    """Return the tags that face the camera and may show in the frame.

    Args:
        cam_from_world: (4, 4) m, a rigid transform or one from ``through_the_lens``.
    """
    centres = transform(cam_from_world, targets.centres)
    right = targets.x_axes @ cam_from_world[:3, :3].T
    up = np.cross(targets.normals, targets.x_axes) @ cam_from_world[:3, :3].T
    whole = targets.cells + 2 * QUIET_CELLS
    side = targets.size_m * whole / targets.cells
    facing = -np.einsum("ij,ij->i", targets.normals @ cam_from_world[:3, :3].T, centres)
    facing /= np.linalg.norm(centres, axis=1)
    focal, centre_px = camera.focal_px, camera.principal_point_px
    size = np.array([camera.width_px, camera.height_px])
    quads = []
    for tag in np.flatnonzero((facing > 0.01) & (centres[:, 2] > side)):
        cell_px = float(focal.max() * targets.size_m / targets.cells / (centres[tag, 2] - 0.7 * side))
        steps = 1
        if camera.distortion.any():
            steps = int(np.ceil(cell_px * whole / TAG_STEP_PX))
        uv = np.stack(np.meshgrid(*[np.linspace(0, 1, steps + 1)] * 2, indexing="xy"), axis=-1).reshape(-1, 2)
        offsets = (uv - 0.5) * side
        vertices = centres[tag] + offsets[:, :1] * right[tag] + offsets[:, 1:] * up[tag]
        vertices = distorted_vertices(vertices, camera.distortion)
        xy_px = vertices[:, :2] / vertices[:, 2:] * focal + centre_px
        if (xy_px.max(axis=0) < -1).any() or (xy_px.min(axis=0) > size).any():
            continue
        quads.append(
            TagQuad(
                tag=int(tag), vertices=vertices, uv=uv, faces=_grid_faces(steps), cell_px=cell_px,
                incidence_cos=float(facing[tag]),
            )
        )  # fmt: skip
    return quads


def _grid_faces(steps: int) -> Ints:
    """Return the (2 steps², 3) triangles of a (steps + 1)² grid, row by row upwards, counter-clockwise."""
    column, row = np.meshgrid(np.arange(steps), np.arange(steps))
    corner = (row * (steps + 1) + column).ravel()
    lower = np.stack([corner, corner + 1, corner + steps + 2], axis=1)
    upper = np.stack([corner, corner + steps + 2, corner + steps + 1], axis=1)
    return np.stack([lower, upper], axis=1).reshape(-1, 3)


def divided(part: Part, longest: float) -> tuple[Floats, Ints]:
    """Return triangles (k, 3, 3) whose edges are at most ``longest`` (m) and the part's face (k,) of each.

    Every triangle is cut at the middle of its longest edge until it is short enough; since the choice depends on
    the edge alone, neighbours cut a shared edge alike and no crack opens.
    """
    triangles, face = part.triangles, np.arange(len(part.faces))
    done, done_face = [], []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        start = edges.argmax(axis=1)
        long = edges[np.arange(len(edges)), start] > longest
        done.append(triangles[~long])
        done_face.append(face[~long])
        triangles, face, start = triangles[long], face[long], start[long]
        order = (start[:, None] + np.arange(3)) % 3
        a, b, c = (triangles[np.arange(len(triangles)), order[:, index]] for index in range(3))
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        face = np.concatenate([face, face])
    return np.concatenate(done), np.concatenate(done_face)


def part_triangles(triangles: Floats, camera: Camera, cam_from_world: Floats, nearest: float) -> tuple[Floats, Bools]:
    """Return (k, 3, 3) triangles (m, world) in the camera frame, recessed and distorted, and the (k,) usable ones.

    A triangle with a vertex nearer than ``nearest`` along the optical axis is not usable.
    """
    in_camera = transform(cam_from_world, triangles)
    usable: Bools = np.all(in_camera[..., 2] > nearest, axis=1)
    bent = np.zeros_like(in_camera)
    bent[usable] = distorted_vertices(in_camera[usable], camera.distortion) * (1 + RECESS)
    return bent, usable


def face_levels(part: Part, look: Appearance) -> Floats:
    """Return the (t,) light levels of the part's faces: Lambert's law, softened."""
    a, b, c = np.moveaxis(part.triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    light = np.asarray(look.light) / np.linalg.norm(look.light)
    mottle = look.mottle * np.random.default_rng(len(part.faces)).uniform(-1, 1, len(part.faces))
    return np.asarray(np.clip(look.face - look.relief * 0.5 * (1 - normals @ light) + mottle, 0.0, 1.0))
