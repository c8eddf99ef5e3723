"""The folder of an image set: photographs of a tagged part with camera.toml and what is known of its tags.

camera.toml         [camera] as in a study; optional [targets] with family and size_mm (edge of the black squares)
images/*.png …      the photographs, or beside camera.toml
                    optional [photographs] with gamma, the exponent of the tone curve (1 for linear; else estimated)
targets.csv         nominal tags as in a study (tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz), or
tags.csv            tag,size_mm, when nothing is known of the part; or nothing: every tag of the family counts
"""

from pathlib import Path

import numpy as np
from pydantic import ValidationError

from netdesign.errors import InputError
from netdesign.files.csv_table import csv_rows
from netdesign.files.parts import load_targets
from netdesign.files.study_text import first_problem, read_toml
from netdesign.model.camera import Camera
from netdesign.model.scene import FAMILIES, Targets
from netdesign.model.study import CameraTable

SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}
MM = 1e-3


def photos_in(folder: Path) -> list[Path]:
    """Return the photographs, by name."""
    place = folder / "images" if (folder / "images").is_dir() else folder
    return sorted(path for path in place.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


def read_gamma(folder: Path) -> float | None:
    """Return the exponent of the tone curve that camera.toml states, None when it is to be estimated.

    Raises:
        InputError: not a number from 0.2 to 5.
    """
    path = folder / "camera.toml"
    table = read_toml(path).get("photographs", {})
    unknown = sorted(set(table) - {"gamma"}) if isinstance(table, dict) else ["photographs"]
    if unknown:
        raise InputError(f"{path}: photographs: expected gamma, found {unknown[0]}")
    gamma = table.get("gamma")
    if gamma is not None and not (isinstance(gamma, int | float) and 0.2 <= gamma <= 5):
        raise InputError(f"{path}: photographs.gamma: expected a number from 0.2 to 5, found {gamma!r}")
    return None if gamma is None else float(gamma)


def read_camera_and_targets(folder: Path) -> tuple[Camera, Targets, bool]:
    """Return the camera, the tags that may occur, and whether their nominal places are known.

    Raises:
        InputError: camera.toml, targets.csv or tags.csv is missing what it needs or malformed.
    """
    path = folder / "camera.toml"
    content = read_toml(path)
    try:
        table = CameraTable.model_validate(content.get("camera", content))
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error, CameraTable)}") from None
    camera = Camera(
        width_px=table.width_px,
        height_px=table.height_px,
        focal_px=np.array(table.focal_px),
        principal_point_px=np.array(table.principal_point_px),
        distortion=np.array(table.distortion),
        sigma_px=table.sigma_px,
        blur_px=table.blur_px,
        full_well_e=table.full_well_e,
        read_noise_e=table.read_noise_e,
    )
    tags = content.get("targets", {}) if "camera" in content else {}
    family = tags.get("family", "tag36h11")
    if family not in FAMILIES:
        raise InputError(f"{path}: targets.family: expected one of {', '.join(FAMILIES)}, found {family!r}")
    size, ids = tags.get("size_mm"), np.arange(FAMILIES[family].ids)
    if (folder / "tags.csv").is_file():
        ids, size = _tag_list(folder / "tags.csv")
    if not (isinstance(size, int | float) and size > 0):
        raise InputError(
            f"{path}: expected targets.size_mm (edge of the tags) or a tags.csv with tag,size_mm, found none"
        )
    if (folder / "targets.csv").is_file():
        return camera, load_targets(folder / "targets.csv", family, float(size) * MM, np.eye(4)), True
    count = len(ids)
    anywhere = Targets(
        ids=ids,
        centres=np.zeros((count, 3)),
        normals=np.tile([0.0, 0, 1], (count, 1)),
        x_axes=np.tile([1.0, 0, 0], (count, 1)),
        size_m=float(size) * MM,
        family=family,
    )
    return camera, anywhere, False


def _tag_list(path: Path) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], float]:
    """Return tag ids and their one size in mm of tags.csv."""
    ids, sizes = [], set()
    for where, row in csv_rows(path, ("tag", "size_mm")):
        try:
            tag, size = int(row["tag"]), float(row["size_mm"])
        except ValueError:
            raise InputError(f"{where}: expected a tag id and a size, found {list(row.values())}") from None
        if tag < 0 or tag in ids or not (np.isfinite(size) and size > 0):
            raise InputError(f"{where}: expected a new tag id and a positive size, found {tag}, {size}")
        ids.append(tag)
        sizes.add(size)
    if len(sizes) != 1:
        raise InputError(f"{path}: expected tags of one size, found {sorted(sizes)}")
    return np.array(ids, dtype=np.int64), sizes.pop()
