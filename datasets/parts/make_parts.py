"""Writes the three made parts of this folder: meshes (STL, mm) and target lists (CSV, mm).

    python datasets/parts/make_parts.py [FOLDER]

Every part is closed, its faces are plane and wound outward, and it stands on a table whose top is at z = -100 mm; the
viewing sphere's centre is the origin. A tag is a row of the CSV: centre, outward unit normal, unit x axis; y = n x u
points up. Round a tag one cell of white (a tenth of 25 mm, the eighth of 20 mm) stays free: the quiet zone that the
detector needs, so a tag takes a square of 25 mm.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import HalfspaceIntersection

TAG_MM = 20.0
TAG_WITH_BORDER_MM = 25.0  # the black square is 8 cells wide, one more cell of white on each side
TABLE_MM = -100.0
FIELDS = "tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz"


def axes_of(normal):
    """Return (x, y) of a tag on a face: x horizontal, y upwards; on a horizontal face x along world x."""
    across = np.cross([0.0, 0.0, 1.0], normal)
    x = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return x, np.cross(normal, x)


def grid_inside(polygon, pitch):
    """Return tag centres (k, 2) on a square grid inside a convex counter-clockwise polygon (n, 2), as many as fit.

    Odd and even numbers of rows and columns are tried about the polygon's centre of area.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    # The square of half width h keeps clear of an edge when its centre is h (|nx| + |ny|) inside.
    clearance = 0.5 * TAG_WITH_BORDER_MM * np.abs(inward).sum(axis=1)
    cross = polygon[:, 0] * np.roll(polygon[:, 1], -1) - np.roll(polygon[:, 0], -1) * polygon[:, 1]
    centre = ((polygon + np.roll(polygon, -1, axis=0)) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    steps = np.arange(-20, 21)
    best = np.zeros((0, 2))
    for shift in [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)]:
        x, y = np.meshgrid((steps + shift[0]) * pitch, (steps + shift[1]) * pitch)
        grid = np.stack([x.ravel(), y.ravel()], axis=1) + centre
        distance = ((grid[:, None] - polygon) * inward).sum(axis=2)
        inside = grid[(distance >= clearance - 1e-9).all(axis=1)]
        if len(inside) > len(best):
            best = inside
    return best


def tags_on(corners, pitch):
    """Return rows (k, 9) of tags on one plane convex face: corners (n, 3) counter-clockwise seen from outside."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    normal /= np.linalg.norm(normal)
    x, y = axes_of(normal)
    flat = np.stack([corners @ x, corners @ y], axis=1)
    centres = grid_inside(flat, pitch)
    on_face = centres[:, :1] * x + centres[:, 1:] * y + (corners[0] @ normal) * normal
    return np.hstack([on_face, np.tile(normal, (len(centres), 1)), np.tile(x, (len(centres), 1))])


def polyhedron():
    """A convex block of 15 faces, 240 x 240 x 200 mm, all but the bottom leaning inward.

    Eight sides lean 22 to 28 degrees, five roof faces 50 to 58; no symmetry, so that no view looks like another.
    """
    planes = [(-90.0, 0.0, -TABLE_MM), (90.0, 0.0, 60.0)]  # elevation and azimuth of the normal (deg), distance (mm)
    planes += [(15.0 + 4.0 * (k % 2), 60.0 * k + 5.0 * (k % 3), 66.0 + 1.5 * (k % 3)) for k in range(6)]
    planes += [(42.0 + 3.0 * (k % 3), 90.0 * k + 24.0, 60.0 + 1.5 * (k % 2)) for k in range(4)]
    elevation, azimuth, distance = np.array(planes).T * np.array([[np.pi / 180], [np.pi / 180], [1.0]])
    normals = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    corners = HalfspaceIntersection(np.column_stack([normals, -distance]), np.zeros(3)).intersections
    faces, rows = [], []
    for normal, offset in zip(normals, distance, strict=True):
        on_plane = corners[np.abs(corners @ normal - offset) < 1e-6]
        on_plane = np.unique(on_plane.round(6), axis=0)
        x, y = axes_of(normal)
        middle = on_plane.mean(axis=0)
        polygon = on_plane[np.argsort(np.arctan2((on_plane - middle) @ y, (on_plane - middle) @ x))]
        faces.append(polygon)
        if normal[2] > -0.5:
            rows.append(tags_on(polygon, 34.0))
    return faces, np.vstack(rows)


def box(low, high):
    """Return the six quadrilaterals of a box, counter-clockwise seen from outside."""
    corners = np.array([[(low, high)[bit][axis] for axis, bit in enumerate(bits)] for bits in np.ndindex(2, 2, 2)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return [corners[list(quad)].astype(float) for quad in quads]


def plate():
    """A flat field: 5 x 5 tags, 50 mm apart, on the upper face (z = 0) of a plate of 270 x 270 x 10 mm."""
    faces = box((-135, -135, -10), (135, 135, 0))
    steps = np.arange(-2, 3) * 50.0
    rows = [[x, y, 0.0, 0, 0, 1, 1, 0, 0] for y in steps for x in steps]
    return faces, np.array(rows)


def bracket():
    """An angle bracket of 220 x 190 x 165 mm with two ribs: the ribs and the wall hide tags from most views.

    The profile in x, z is swept along y: an L outside the ribs, an L with its inner corner filled inside them.
    """
    thick, leg, length, height = 15.0, 85.0, 220.0, 165.0
    outline = {
        "O": (0, 0), "B": (length, 0), "D": (length, thick), "P": (thick + leg, thick), "C": (thick, thick),
        "Q": (thick, thick + leg), "E": (thick, height), "F": (0, height),
    }  # fmt: skip
    cuts = [0.0, 35.0, 65.0, 125.0, 155.0, 190.0]
    origin = np.array([-length / 2, -cuts[-1] / 2, TABLE_MM])

    def at(letter, y):
        x, z = outline[letter]
        return np.array([x, y, z]) + origin

    faces = []
    for k, (start, end) in enumerate(pairwise(cuts)):
        letters = "OBDPQEF" if k % 2 else "OBDPCQEF"  # every second stretch is a rib
        for a, b in zip(letters, letters[1:] + letters[0], strict=True):
            faces.append(np.array([at(a, start), at(a, end), at(b, end), at(b, start)]))
    ribs = [np.array([at(c, y) for c in ("PCQ" if k % 2 else "PQC")]) for k, y in enumerate(cuts[1:-1])]
    for k in range(1, 7):  # the two ends: an L is star-shaped seen from its outer corner
        a, b = "OBDPCQEF"[k : k + 2]
        faces.append(np.array([at("O", cuts[0]), at(a, cuts[0]), at(b, cuts[0])]))
        faces.append(np.array([at("O", cuts[-1]), at(b, cuts[-1]), at(a, cuts[-1])]))
    faces += ribs

    wide = cuts[-1]
    places = [*ribs]
    for a, b in ("PD", "EQ"):
        places.append(np.array([at(a, 0), at(b, 0), at(b, wide), at(a, wide)]))
    places.append(np.array([at("O", 0), at("F", 0), at("F", wide), at("O", wide)]))
    for k, (y0, y1) in enumerate(pairwise(cuts)):
        if k % 2:
            places.append(np.array([at("Q", y0), at("P", y0), at("P", y1), at("Q", y1)]))
        else:
            places.append(np.array([at("C", y0), at("P", y0), at("P", y1), at("C", y1)]))
            places.append(np.array([at("Q", y0), at("C", y0), at("C", y1), at("Q", y1)]))
    return faces, np.vstack([tags_on(place, 45.0) for place in places])


def mesh_of(faces):
    """Return the closed mesh of plane convex faces, corners in order."""
    triangles = [face[[0, k, k + 1]] for face in faces for k in range(1, len(face) - 1)]
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(np.array(triangles)), process=False)
    mesh.merge_vertices(digits_vertex=5)
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise ValueError("the faces do not close to an outward-wound solid")
    return mesh


def write_part(folder, name, faces, rows):
    """Write NAME.stl and NAME_tags.csv; tag ids count from 0."""
    mesh = mesh_of(faces)
    (folder / f"{name}.stl").write_bytes(trimesh.exchange.stl.export_stl(mesh))
    lines = [",".join([str(tag), *(f"{value + 0.0:.9g}" for value in row.round(9))]) for tag, row in enumerate(rows)]
    (folder / f"{name}_tags.csv").write_text("\n".join([FIELDS, *lines]) + "\n", encoding="utf-8")
    return mesh


def main():
    """Write all parts into the folder given, by default this file's own."""
    parser = argparse.ArgumentParser(description="Write polyhedron, plate and bracket with their tags.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent)
    folder = parser.parse_args().folder
    for name, make in (("polyhedron", polyhedron), ("plate", plate), ("bracket", bracket)):
        faces, rows = make()
        mesh = write_part(folder, name, faces, rows)
        size = " x ".join(f"{edge:.0f}" for edge in mesh.extents)
        print(f"{name}: {len(mesh.faces)} triangles, {size} mm, {len(rows)} tags")


if __name__ == "__main__":
    main()
