"""Small scenes for the tests: built here, no files."""

import numpy as np

from netdesign.model.camera import Camera
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.scene import Part, Scene, Targets
from netdesign.model.stations import ViewingSphere
from netdesign.model.task import VisibilityLimits

CAMERA = Camera(
    width_px=2448, height_px=2048, focal_px=[3600, 3600], principal_point_px=[1223.5, 1023.5], distortion=[0, 0, 0, 0]
)
LIMITS = VisibilityLimits(
    max_incidence=np.radians(65), min_tag_px=25, border_px=10, min_rays=3, min_points_per_image=8, occlusion=True
)


def box_part(size=(0.24, 0.20, 0.16), centre=(0.0, 0.0, 0.0)):
    """A closed box, outward faces counter-clockwise."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size + centre
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return Part(vertices=corners, faces=faces)


def box_scene(size=(0.24, 0.20, 0.16), spacing=0.05, tag_size=0.02):
    """A box with a grid of tags on every face but the bottom."""
    size = np.array(size)
    centres, normals, x_axes = [], [], []
    for normal, x_axis in (
        ((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, 1, 0)), ((-1, 0, 0), (0, -1, 0)),
        ((0, 1, 0), (-1, 0, 0)), ((0, -1, 0), (1, 0, 0)),
    ):  # fmt: skip
        normal, x_axis = np.array(normal, float), np.array(x_axis, float)
        y_axis = np.cross(normal, x_axis)
        width, height = abs(size @ x_axis), abs(size @ y_axis)
        columns, rows = int((width - 0.03) // spacing) + 1, int((height - 0.03) // spacing) + 1
        for column in range(columns):
            for row in range(rows):
                offset = (column - (columns - 1) / 2) * spacing * x_axis + (row - (rows - 1) / 2) * spacing * y_axis
                centres.append(normal * abs(size @ normal) / 2 + offset)
                normals.append(normal)
                x_axes.append(x_axis)
    targets = Targets(ids=np.arange(len(centres)), centres=centres, normals=normals, x_axes=x_axes, size_m=tag_size)
    return Scene(part=box_part(size), targets=targets)


def plate_scene(side=5, spacing=0.05, tag_size=0.02):
    """A thin plate with side x side tags on its upper face, z = 0."""
    steps = (np.arange(side) - (side - 1) / 2) * spacing
    centres = np.array([[x, y, 0.0] for x in steps for y in steps])
    width = side * spacing + 0.02
    targets = Targets(
        ids=np.arange(side * side),
        centres=centres,
        normals=np.tile([0.0, 0, 1], (side * side, 1)),
        x_axes=np.tile([1.0, 0, 0], (side * side, 1)),
        size_m=tag_size,
    )
    return Scene(part=box_part((width, width, 0.01), (0, 0, -0.005)), targets=targets)


def sphere(radius=0.6, roll=0.0, max_images=16, elevation=(10, 90)):
    """The viewing hemisphere about the origin."""
    low, high = np.radians(elevation)
    return ViewingSphere(
        centre=[0, 0, 0], radius=radius, azimuth=(-np.pi, np.pi), elevation=(low, high), roll=roll,
        max_images=max_images,
    )  # fmt: skip


def ring(count, elevation_deg=50.0, radius=0.6, roll=0.0):
    """``count`` cameras (count, 4, 4) at equal azimuths that look at the origin."""
    alpha = np.arange(count) * 2 * np.pi / count + 0.1
    viewpoints = np.stack([alpha, np.full(count, np.radians(elevation_deg))], axis=1)
    return look_at(radius * sphere_directions(viewpoints), np.zeros(3), roll)
