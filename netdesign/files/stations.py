"""Stations that exist already: read from a design, a program, a table of stations or a COLMAP images.txt.

Whatever the source, it becomes the table that ``netdesign export --format csv`` writes before it is used: a run keeps
that table, and running again from it gives the same bytes.
"""

import csv
import json
from pathlib import Path

import numpy as np

from netdesign.errors import InputError
from netdesign.files.colmap_text import read_images
from netdesign.files.csv_table import numbers, table_rows
from netdesign.files.design_json import read_design
from netdesign.files.packages import resolve_path
from netdesign.files.robot_program import stations_csv
from netdesign.files.store import read_json
from netdesign.model.arrays import Floats
from netdesign.model.frames import inverse, pose, rotation_from_quaternion, viewpoints_of

MM = 1e-3
COLUMNS = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
KINDS = "a design.json (with #ID), a program or table that export writes, or a COLMAP images.txt"


def stations_table(reference: str, folder: Path) -> bytes:
    """Return the table of the stations named by ``reference``: a file, with "#ID" for one network of a design.

    Args:
        folder: what a relative path is relative to.

    Raises:
        InputError: no such file, not one of the formats, or no such network; the message says which there are.
    """
    name, _, network = reference.partition("#")
    path = resolve_path(name, folder)
    if path.is_dir() and (path / "design.json").is_file():
        path = path / "design.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix == ".json":
        poses = _of_json(path, network)
    elif path.suffix == ".txt":
        poses = _of_colmap(path)
    elif path.suffix == ".csv":
        content = path.read_bytes()
        parse_stations(content, path)
        return content
    else:
        raise InputError(f"{path}: expected {KINDS}, found a file that ends with {path.suffix!r}")
    return stations_csv(viewpoints_of(-poses[:, :3, 2]), poses, None, ()).encode()


def parse_stations(content: bytes, path: Path) -> Floats:
    """Return world_from_cam (n, 4, 4) m of a table of stations; ``path`` is for messages.

    Raises:
        InputError: not a table, a column is missing, or a number cannot be read.
    """
    try:
        rows = table_rows(content.decode("utf-8-sig"), path, COLUMNS)
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected a table of stations (CSV), found {error}") from None
    if not rows:
        raise InputError(f"{path}: expected at least one station, found none")
    values = np.array([numbers(where, row, COLUMNS) for where, row in rows])
    return _poses(values[:, :3], values[:, 3:], path)


def _poses(position_mm: Floats, quaternion: Floats, path: Path) -> Floats:
    size = np.linalg.norm(quaternion, axis=1)
    for row in np.flatnonzero(~np.isfinite(position_mm).all(axis=1) | ~(np.abs(size - 1.0) < 1e-3)):
        raise InputError(
            f"{path}: station {row}: expected finite numbers and a unit quaternion, found norm {size[row]:.4g}"
        )
    return pose(rotation_from_quaternion(quaternion), position_mm * MM)


def _of_json(path: Path, network: str) -> Floats:
    try:
        kind = json.loads(path.read_text(encoding="utf-8")).get("format")
    except (json.JSONDecodeError, UnicodeDecodeError, AttributeError):
        raise InputError(f"{path}: expected {KINDS}, found no JSON object") from None
    if kind == "netdesign/program/1":
        found = [item["world_from_cam_mm"] for item in read_json(path, "program")["stations"]]
    else:
        networks = {str(item["id"]): item for item in read_design(path)["networks"]}
        if not network and len(networks) == 1:
            network = next(iter(networks))
        if network not in networks:
            said = f"found #{network}" if network else "found no #ID"
            raise InputError(
                f"{path}: expected the id of a network behind the name, #0 to #{len(networks) - 1}, {said}"
            )
        found = networks[network]["world_from_cam_mm"]
    poses = np.array(found, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"{path}: expected 4x4 matrices world_from_cam_mm, found an array of shape {poses.shape}")
    poses[:, :3, 3] *= MM
    return poses


def _of_colmap(path: Path) -> Floats:
    images = read_images(path)
    if not images:
        raise InputError(f"{path}: expected at least one image, found none")
    quaternions = np.array([image.quaternion for image in images])[:, [1, 2, 3, 0]]
    return inverse(_poses(np.array([image.translation for image in images]), quaternions, path))
