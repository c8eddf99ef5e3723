"""Parts and targets: meshes, tag lists, and tags spread over the faces of a mesh."""

import warnings
from pathlib import Path

import numpy as np
import trimesh

from netdesign.errors import InputError
from netdesign.files.csv_table import csv_rows
from netdesign.model.arrays import Floats
from netdesign.model.frames import transform
from netdesign.model.scene import FAMILIES, Part, Targets

UNIT_M = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
TAG_COLUMNS = ("tag", "x_mm", "y_mm", "z_mm", "nx", "ny", "nz", "ux", "uy", "uz")
CAD = {".step", ".stp", ".iges", ".igs", ".brep", ".sldprt", ".ipt", ".catpart", ".prt", ".x_t", ".fcstd"}
PHASES = 12  # steps of a spacing by which a grid is moved to make tags fit


def load_part(path: Path, unit: str, world_from_mesh: Floats) -> Part:
    """Read a triangle mesh and place it in the world frame.

    Args:
        path: any mesh trimesh reads.  unit: mm, m or inch.  world_from_mesh: (4, 4), metres.

    Raises:
        InputError: missing, unreadable, without triangles, or with coordinates that are not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such mesh (part.mesh)")
    if path.suffix.lower() in CAD:
        raise InputError(f"{path}: expected a triangle mesh (STL, OBJ, PLY, OFF, GLB), found CAD: export it as STL")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = trimesh.load(path, force="mesh", process=False)
    except (ValueError, TypeError, KeyError, IndexError, ImportError, OSError, NotImplementedError) as error:
        raise InputError(
            f"{path}: expected a mesh, found {' '.join(str(error).split()) or type(error).__name__}"
        ) from None
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    if len(faces) == 0:
        raise InputError(f"{path}: expected a mesh with triangles, found none")
    broken = int((~np.isfinite(vertices).all(axis=1)).sum())
    if broken:
        raise InputError(f"{path}: expected finite coordinates, found {broken} vertices with NaN or infinity")
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    if len(mesh.faces) == 0:
        raise InputError(f"{path}: expected a mesh with an area, found only degenerate triangles")
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    if mesh.is_watertight and mesh.volume < 0:
        faces = faces[:, ::-1]
    return Part(vertices=transform(world_from_mesh, vertices * UNIT_M[unit]), faces=faces)


def load_targets(path: Path, family: str, size_m: float, world_from_mesh: Floats) -> Targets:
    """Read a list of tags (columns ``TAG_COLUMNS``, mesh frame) and place it in the world frame.

    Raises:
        InputError: with file and line: a column is missing, a number is not one, a tag id is repeated or outside the
            family, a normal or x axis has no direction or the two are not at right angles (1 degree).
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file (targets.file)")
    tags: dict[int, tuple[Floats, Floats, Floats]] = {}
    for where, line in csv_rows(path, TAG_COLUMNS):
        try:
            tag, values = _whole_number(line["tag"]), np.array([float(line[name]) for name in TAG_COLUMNS[1:]])
        except (TypeError, ValueError):
            raise InputError(f"{where}: expected an integer and nine numbers, found {list(line.values())}") from None
        last = FAMILIES[family].ids - 1
        if not 0 <= tag <= last:
            raise InputError(f"{where}: expected a tag id from 0 to {last} of {family}, found {tag}")
        if tag in tags:
            raise InputError(f"{where}: tag {tag} stands in the list twice")
        centre, normal, x_axis = values.reshape(3, 3)
        lengths = np.linalg.norm([normal, x_axis], axis=1)
        if not np.isfinite(values).all() or lengths.min() < 1e-6:
            raise InputError(f"{where}: expected finite numbers and a direction, found {values.tolist()}")
        normal, x_axis = normal / lengths[0], x_axis / lengths[1]
        if abs(normal @ x_axis) > np.sin(np.radians(1.0)):
            raise InputError(
                f"{where}: expected the x axis at right angles to the normal, found tag {tag} off by more than 1 deg"
            )
        x_axis = x_axis - normal * (normal @ x_axis)
        tags[tag] = centre, normal, x_axis / np.linalg.norm(x_axis)
    if not tags:
        raise InputError(f"{path}: expected at least one tag, found none")
    centres, normals, x_axes = (np.array(column) for column in zip(*tags.values(), strict=True))
    rotation = world_from_mesh[:3, :3]
    return Targets(
        ids=np.array(list(tags)),
        centres=transform(world_from_mesh, centres * UNIT_M["mm"]),
        normals=normals @ rotation.T,
        x_axes=x_axes @ rotation.T,
        size_m=size_m,
        family=family,
    )


def _whole_number(text: str) -> int:
    """Return an integer, written as one or, as spreadsheets do, with a zero behind its point."""
    try:
        return int(text)
    except ValueError:
        value = float(text)
        if not value.is_integer():
            raise
        return int(value)


def spread_targets(part: Part, family: str, size_m: float, spacing_m: float) -> Targets:
    """Put tags on a square grid on every flat face of the part that has room for them.

    A flat face is a group of coplanar neighbouring triangles; a tag goes where the black square and its quiet zone of
    one cell lie inside the face. The grid is centred; on a part that has no room for a tag so, it is moved to where
    most fit. Faces are taken from the largest to the smallest until the family has no more ids.

    Raises:
        InputError: no face has room for a tag, or the spacing is smaller than a tag with its quiet zone.
    """
    cells = FAMILIES[family].cells
    outer = size_m * (cells + 2) / cells  # one white cell around the black square
    if spacing_m < outer:
        raise InputError(
            f"targets.spacing_mm: expected at least {outer * 1e3:g} (tag and quiet zone), found {spacing_m * 1e3:g}"
        )
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    groups = [np.asarray(group) for group in mesh.facets] + [
        np.array([face]) for face in np.setdiff1d(np.arange(len(mesh.faces)), np.concatenate([*mesh.facets, [-1]]))
    ]
    areas = np.array([mesh.area_faces[group].sum() for group in groups])
    large = [index for index in np.argsort(-areas, kind="stable") if areas[index] >= outer**2]
    found: list[tuple[Floats, Floats, Floats]] = []
    for moved in (False, True):
        for index in [] if found else large:
            normal = np.asarray(mesh.face_normals[groups[index][0]])
            places = _grid(part.triangles[groups[index]], normal, spacing_m, outer, moved)
            found += [(centre, normal, x_axis) for centre, x_axis in places]
    found = found[: FAMILIES[family].ids]
    if not found:
        raise InputError(
            f"targets.spacing_mm: no flat face of the part has room for a tag of {outer * 1e3:g} mm with its quiet "
            f"zone; the largest flat face has {areas.max() * 1e6:.0f} mm²"
        )
    centres, normals, x_axes = (np.array(column) for column in zip(*found, strict=True))
    return Targets(
        ids=np.arange(len(found)), centres=centres, normals=normals, x_axes=x_axes, size_m=size_m, family=family
    )


def _grid(triangles: Floats, normal: Floats, spacing: float, outer: float, moved: bool) -> list[tuple[Floats, Floats]]:
    """Return (centre, x axis) of the tags on one flat face (t, 3, 3).

    The grid is centred on the bounding box of the face, or ``moved`` to where most tags fit.
    """
    reference = np.array([0.0, 0, 1]) if abs(normal[2]) < 0.9 else np.array([0.0, 1, 0])
    x_axis = np.cross(reference, normal)
    x_axis = x_axis / np.linalg.norm(x_axis)
    y_axis = np.cross(normal, x_axis)
    flat = np.stack([triangles @ x_axis, triangles @ y_axis], axis=-1)
    low, high = flat.reshape(-1, 2).min(axis=0), flat.reshape(-1, 2).max(axis=0)
    # Inside: a dense border of sample points, half a quiet cell apart, lies in the face; enough for convex notches.
    ticks = np.linspace(-outer / 2, outer / 2, 21)
    border = np.array([(x, y) for x in ticks for y in ticks])
    height = float((triangles[0] @ normal).mean())
    middle, room = (low + high) / 2, high - low - outer
    if (room < 0).any():
        return []
    if not moved:
        counts = np.floor(room / spacing + 1e-9).astype(int) + 1
        starts = [middle - (counts - 1) / 2 * spacing]
    else:
        starts = [low + outer / 2 + np.array([i, j]) / PHASES * spacing for j in range(PHASES) for i in range(PHASES)]
    last = high - outer / 2
    fitting = max((_fitting(start, last, spacing, border, flat) for start in starts), key=len)
    return [(x * x_axis + y * y_axis + height * normal, x_axis) for x, y in fitting]


def _fitting(first: Floats, last: Floats, spacing: float, border: Floats, flat: Floats) -> list[Floats]:
    """Return the places (2,) of a grid from ``first`` to ``last``, row by row, whose tag lies in the face (t, 3, 2)."""
    columns, rows = (np.floor((last - first) / spacing + 1e-9).astype(int) + 1).tolist()
    places = [first + spacing * np.array([i, j]) for j in range(rows) for i in range(columns)]
    return [place for place in places if _covered(border + place, flat)]


def _covered(points: Floats, triangles: Floats) -> bool:
    """Whether every point (p, 2) lies in one of the triangles (t, 3, 2)."""
    start, end = triangles, np.roll(triangles, -1, axis=1)
    edge = end - start
    offset = points[:, None, None, :] - start
    side = edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0]
    tolerance = 1e-9 * float(np.abs(edge).max()) ** 2
    inside = np.all(side >= -tolerance, axis=2) | np.all(side <= tolerance, axis=2)
    return bool(np.all(np.any(inside, axis=1)))
