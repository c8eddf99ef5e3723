"""The second renderer: exact area coverage, numpy and numba only.

Cross-check of the pyrender one and what makes pictures where EGL is missing. The outlines of a tag's cells are
projected point by point through the full camera model and their area in every sub-pixel is summed exactly, edge by
edge: an edge adds, in each row it crosses, its signed height to all sub-pixels on its right and the part of its own
sub-pixel on its right. Nothing is sampled, so there is no aliasing. The part itself, which is only scenery, is drawn
through a depth buffer with one sample per sub-pixel; where it stands in front of a tag it hides it.
"""

import numpy as np
from numpy.typing import NDArray

from netdesign.imaging.geometry import FACE_STEP_PX, distorted_vertices, divided, face_levels, part_triangles, tag_quads
from netdesign.imaging.looks import Appearance
from netdesign.imaging.optics import Picture, decimate
from netdesign.imaging.tags import QUIET_CELLS, cells
from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.compiled import entry, part
from netdesign.model.frames import transform
from netdesign.model.scene import Scene

SUBPIXELS = 4  # along a pixel; coverage is exact, they only carry the blur (at 2 an edge square to them moves 0.01 px)
EDGE_STEP_PX = 3.0  # of an outline under distortion: a chord of 3 px is 0.0005 px off the curve
IN_FRONT = 5e-3  # share of the distance by which the part must be nearer than a tag to hide it


@part()
def _add_edge(area: Floats, x0: float, y0: float, x1: float, y1: float, weight: float) -> None:
    """Add the signed area to the right of one edge; y downwards, coordinates in sub-pixels from the array's corner."""
    rows, columns = area.shape
    if y0 == y1:
        return
    if y0 > y1:
        x0, y0, x1, y1, weight = x1, y1, x0, y0, -weight
    slope = (x1 - x0) / (y1 - y0)
    if y0 < 0.0:
        x0, y0 = x0 - slope * y0, 0.0
    y1 = min(y1, float(rows))
    x, y = x0, y0
    while y < y1 - 1e-12:
        row = int(np.floor(y + 1e-12))
        if row >= rows:
            break
        next_y = min(row + 1.0, y1)
        next_x = x + slope * (next_y - y)
        # Cut the piece at column borders; inside one column the area is a trapezoid.
        a, b, height = min(x, next_x), max(x, next_x), next_y - y
        per_column = height / (b - a) if b > a else 0.0
        at = a
        while True:
            column = int(np.floor(at))
            end = min(column + 1.0, b)
            share = weight * (per_column * (end - at) if b > a else height)
            if column < 0:
                area[row, 0] += share
            elif column < columns - 1:
                right = 0.5 * (at + end) - column
                area[row, column] += share * (1.0 - right)
                area[row, column + 1] += share * right
            if end >= b:
                break
            at = end
        x, y = next_x, next_y


@entry()
def _add_outline(area: Floats, xy: Floats, weight: float) -> None:
    """Add the area of a closed polygon (k, 2); summing ``area`` along x afterwards gives the coverage."""
    for index in range(len(xy)):
        following = (index + 1) % len(xy)
        _add_edge(area, xy[index, 0], xy[index, 1], xy[following, 0], xy[following, 1], weight)


@entry()
def _draw_triangles(xyz: Floats, level: Floats, light: NDArray[np.float32], inverse_depth: NDArray[np.float32]) -> None:
    """Draw triangles (t, 3, 3) of sub-pixel x, y and 1/depth; the largest 1/depth wins."""
    rows, columns = light.shape
    for index in range(len(xyz)):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = xyz[index, 0], xyz[index, 1], xyz[index, 2]
        double = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(double) < 1e-12:
            continue
        for row in range(max(int(np.ceil(min(ay, by, cy))), 0), min(int(max(ay, by, cy)) + 1, rows)):
            for column in range(max(int(np.ceil(min(ax, bx, cx))), 0), min(int(max(ax, bx, cx)) + 1, columns)):
                q = ((column - ax) * (cy - ay) - (cx - ax) * (row - ay)) / double
                r = ((bx - ax) * (row - ay) - (column - ax) * (by - ay)) / double
                if q < 0.0 or r < 0.0 or q + r > 1.0:
                    continue
                near = az + q * (bz - az) + r * (cz - az)
                if near > inverse_depth[row, column]:
                    inverse_depth[row, column] = near
                    light[row, column] = level[index]


class ReferenceRenderer:
    """Draws one scene with one camera."""

    def __init__(self, scene: Scene, camera: Camera, appearance: Appearance | None = None) -> None:
        self.scene, self.camera = scene, camera
        self.appearance = appearance or Appearance()
        self._level = face_levels(scene.part, self.appearance)

    def render(self, cam_from_world: Floats) -> Picture:
        """Return the (h, w) light on the sensor, full scale 1; arguments as for ``render.Renderer.render``."""
        camera = self.camera
        shape = (camera.height_px * SUBPIXELS, camera.width_px * SUBPIXELS)
        light = np.full(shape, self.appearance.background, np.float32)
        inverse_depth = np.zeros(shape, np.float32)
        self._draw_part(cam_from_world, light, inverse_depth)
        for quad in tag_quads(self.scene.targets, camera, cam_from_world):
            self._draw_tag(quad.tag, cam_from_world, light, inverse_depth)
        return decimate(light, camera.blur_px, SUBPIXELS, 0, camera.height_px)

    def _draw_part(self, cam_from_world: Floats, light: Picture, inverse_depth: Picture) -> None:
        bent, level = self._part_faces(cam_from_world)
        xyz = np.concatenate([self._subpixels(bent) - 0.5, 1 / bent[..., 2:]], axis=-1)
        _draw_triangles(xyz, level, light, inverse_depth)

    def _part_faces(self, cam_from_world: Floats) -> tuple[Floats, Floats]:
        """Return (t, 3, 3) faces in the camera frame, recessed, distorted, fine enough for it; and their levels."""
        part, camera = self.scene.part, self.camera
        triangles, face = part.triangles, np.arange(len(part.faces))
        if camera.distortion.any():
            distance = np.linalg.norm(transform(cam_from_world, part.vertices), axis=1).min()
            triangles, face = divided(part, FACE_STEP_PX * max(float(distance), 0.05) / float(camera.focal_px.max()))
        bent, usable = part_triangles(triangles, camera, cam_from_world, nearest=1e-3)
        return bent[usable], self._level[face[usable]]

    def _draw_tag(self, tag: int, cam_from_world: Floats, light: Picture, inverse_depth: Picture) -> None:
        targets, look = self.scene.targets, self.appearance
        outer = self._outline(tag, -QUIET_CELLS, -QUIET_CELLS, targets.cells + 2 * QUIET_CELLS, cam_from_world)
        low = np.maximum(np.floor(outer[:, :2].min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(outer[:, :2].max(axis=0)).astype(int) + 2, light.shape[::-1])
        if (high - low < 3).any():
            return
        size = (high - low)[::-1]
        whole, dark = np.zeros(size), np.zeros(size)
        _add_outline(whole, outer[:, :2] - low, 1.0)
        _add_outline(dark, self._outline(tag, 0, 0, targets.cells, cam_from_world)[:, :2] - low, 1.0)
        for row, column in np.argwhere(cells(targets.family, int(targets.ids[tag])) == 1):
            _add_outline(dark, self._outline(tag, column, row, 1, cam_from_world)[:, :2] - low, -1.0)
        # The orientation of the outlines in the picture decides the sign of all areas alike.
        whole, dark = np.abs(np.cumsum(whole, axis=1)), np.abs(np.cumsum(dark, axis=1))
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        hidden = inverse_depth[window] > outer[:, 2].max() * (1 + IN_FRONT)
        if hidden.any():  # something may be in front: ask for every sub-pixel
            rows, columns = np.indices(size)
            design = np.column_stack([outer[:, :2] - low - 0.5, np.ones(len(outer))])
            plane = np.linalg.lstsq(design, outer[:, 2], rcond=None)[0]
            hidden = inverse_depth[window] > (plane[0] * columns + plane[1] * rows + plane[2]) * (1 + IN_FRONT)
            whole, dark = np.where(hidden, 0.0, whole), np.where(hidden, 0.0, dark)
        light[window] = light[window] * (1 - whole) + look.white * (whole - dark) + look.black * dark

    def _outline(self, tag: int, u: float, v: float, width: float, cam_from_world: Floats) -> Floats:
        """Return (k, 3) sub-pixel x, y and 1/depth along the square of ``width`` cells at cell coordinates (u, v)."""
        targets, camera = self.scene.targets, self.camera
        distance = float(np.linalg.norm(transform(cam_from_world, targets.centres[tag])))
        length_px = width * targets.size_m / targets.cells * float(camera.focal_px.max()) / distance
        steps = int(np.ceil(length_px / EDGE_STEP_PX)) if camera.distortion.any() else 1
        along = np.arange(max(steps, 1)) / max(steps, 1) * width
        zero, full = np.zeros_like(along), np.full_like(along, width)
        across = u + np.concatenate([along, full, width - along, zero])
        down = v + np.concatenate([zero, along, full, width - along])
        step = targets.size_m / targets.cells
        up = np.cross(targets.normals[tag], targets.x_axes[tag])
        points = targets.centres[tag] + step * (
            (across[:, None] - targets.cells / 2) * targets.x_axes[tag] - (down[:, None] - targets.cells / 2) * up
        )
        bent = distorted_vertices(transform(cam_from_world, points), camera.distortion)
        return np.concatenate([self._subpixels(bent), 1 / bent[:, 2:]], axis=1)

    def _subpixels(self, in_camera: Floats) -> Floats:
        """Return (…, 2) sub-pixel coordinates, origin at the picture's top-left corner."""
        xy_px = in_camera[..., :2] / in_camera[..., 2:] * self.camera.focal_px + self.camera.principal_point_px
        return np.asarray((xy_px + 0.5) * SUBPIXELS)

    def depth_and_tags(self, cam_from_world: Floats) -> tuple[NDArray[np.float32], NDArray[np.uint16]]:
        """Return what each pixel's centre shows: depth (h, w) in m along the optical axis, 0 for nothing, and the tag.

        The tag mask (h, w) holds id + 1 over a tag and its quiet zone, 0 elsewhere.
        """
        camera, targets = self.camera, self.scene.targets
        inverse_depth = np.zeros((camera.height_px, camera.width_px), np.float32)
        tags = np.zeros((camera.height_px, camera.width_px), np.float32)
        shapes = [(self._part_faces(cam_from_world)[0], 0.0)] + [
            (quad.vertices[quad.faces], float(targets.ids[quad.tag] + 1))
            for quad in tag_quads(targets, camera, cam_from_world)
        ]
        for triangles, mark in shapes:
            xy_px = triangles[..., :2] / triangles[..., 2:] * camera.focal_px + camera.principal_point_px
            xyz = np.concatenate([xy_px, 1 / triangles[..., 2:]], axis=-1)
            _draw_triangles(xyz, np.full(len(xyz), mark), tags, inverse_depth)
        seen = inverse_depth > 0
        depth = np.divide(1.0, inverse_depth, out=np.zeros_like(inverse_depth), where=seen)
        return depth, tags.astype(np.uint16)
