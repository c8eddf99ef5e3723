"""Observation sets: a COLMAP text model with observations.csv, control.csv and scalebars.csv beside it.

Lengths in these files are mm; pixels in observations.csv count from the centre of the top-left pixel. A network folder
of a run is an observation set too: its observations.csv names tag and corner instead of the point.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netdesign.errors import InputError
from netdesign.files.colmap import point3d_id, read_model
from netdesign.model.adjustment import ControlPoints, ScaleBars
from netdesign.model.arrays import Floats, Ints
from netdesign.model.network import Observations

MM = 1e-3
DEFAULT_SIGMA_PX = 1.0


@dataclass(frozen=True, kw_only=True)
class ObservationSet:
    """What a folder holds, in SI units.

    Attributes:
        image_names: (n,).  point_names: (m,) POINT3D_IDs as text.  intrinsics: (c, 8).  camera_of_image: (n,).
        world_from_cam: (n, 4, 4) m, points: (m, 3) m: approximate values.
        observations: with the covariances of observations.csv, of ``sigma_px`` or of DEFAULT_SIGMA_PX.
        sigma_known: False when nothing gave the noise and DEFAULT_SIGMA_PX stands for it.
    """

    image_names: tuple[str, ...]
    point_names: tuple[str, ...]
    intrinsics: Floats
    camera_of_image: Ints
    world_from_cam: Floats
    points: Floats
    observations: Observations
    sigma_known: bool


def read_observation_set(folder: Path, sigma_px: float | None) -> ObservationSet:
    """Read a COLMAP text model and, if there is one, its observations.csv.

    Args:
        sigma_px: image-coordinate noise; takes the place of the covariances in observations.csv.

    Raises:
        InputError: a file is missing or malformed; the message says which line.
    """
    if sigma_px is not None and not (np.isfinite(sigma_px) and sigma_px > 0):
        raise InputError(f"sigma_px: expected a positive number, found {sigma_px}")
    path = folder / "observations.csv"
    model = read_model(folder, with_points2d=not path.is_file())
    for what, count in (("image", len(model.names)), ("point", len(model.point_ids))):
        if count == 0:
            raise InputError(f"{folder}: expected a COLMAP model with {what}s, found none")
    repeated = sorted({name for name in model.names if model.names.count(name) > 1})
    if repeated:
        raise InputError(f"{folder / 'images.txt'}: expected unique image names, found {repeated[0]} twice")
    variance = (DEFAULT_SIGMA_PX if sigma_px is None else sigma_px) ** 2
    if path.is_file():
        observations, known = _read_observations(path, model.names, model.point_ids, variance, sigma_px is not None)
    else:
        observations = Observations(
            image=model.image,
            point=model.point,
            xy_px=model.xy_px,
            covariance=np.tile(variance * np.eye(2), (len(model.image), 1, 1)),
        )
        known = sigma_px is not None
    if len(observations) == 0:
        raise InputError(f"{folder}: expected image points that belong to object points, found none")
    return ObservationSet(
        image_names=model.names,
        point_names=tuple(str(number) for number in model.point_ids),
        intrinsics=np.array([camera.intrinsics for camera in model.cameras]),
        camera_of_image=model.camera_of_image,
        world_from_cam=model.world_from_cam,
        points=model.points,
        observations=observations,
        sigma_known=known,
    )


def csv_rows(path: Path, required: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return ("file:line", row) of a CSV file with at least the given columns.

    Raises:
        InputError: no such file, not text, or a column is missing.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected UTF-8 text, found {error.reason} at byte {error.start}") from None
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    names = [name.strip() for name in reader.fieldnames or ()]
    reader.fieldnames = names
    missing = [name for name in required if name not in names]
    if missing:
        raise InputError(f"{path}:1: expected columns {','.join(required)}, found no {missing[0]}")
    rows = []
    for row in reader:
        where = f"{path}:{reader.line_num}"
        if None in row or any(value is None for value in row.values()):
            raise InputError(f"{where}: expected {len(names)} values, found another number of them")
        rows.append((where, {name: value.strip() for name, value in row.items()}))
    return rows


def _numbers(where: str, row: dict[str, str], names: Sequence[str]) -> list[float]:
    """Return finite numbers of a row."""
    values = []
    for name in names:
        try:
            value = float(row[name])
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise InputError(f"{where}: {name}: expected a finite number, found {row[name]!r}")
        values.append(value)
    return values


def _index(where: str, what: str, key: str, table: dict[str, int]) -> int:
    if key not in table:
        raise InputError(f"{where}: {what} {key!r} is not in the COLMAP model")
    return table[key]


def _read_observations(
    path: Path, names: Sequence[str], point_ids: Sequence[int], variance: float, override: bool
) -> tuple[Observations, bool]:
    """Return the observations and whether their noise is known; ``override`` puts ``variance`` in its place."""
    with path.open(encoding="utf-8-sig") as file:
        head = [name.strip() for name in file.readline().split(",")]
    by_tag = "point" not in head and "tag" in head
    rows = csv_rows(path, ["image", *(["tag", "corner"] if by_tag else ["point"]), "x_px", "y_px"])
    covariance_columns = ["sxx_px2", "sxy_px2", "syy_px2"]
    given = bool(rows) and all(name in rows[0][1] for name in covariance_columns)
    images = {name: index for index, name in enumerate(names)}
    points = {str(number): index for index, number in enumerate(point_ids)}
    image, point, xy, covariance = [], [], [], []
    seen: set[tuple[int, int]] = set()
    for where, row in rows:
        key = row["point"] if not by_tag else _point_of_tag(where, row)
        pair = _index(where, "image", row["image"], images), _index(where, "point", key, points)
        xy.append(_numbers(where, row, ["x_px", "y_px"]))
        if pair in seen:
            raise InputError(f"{where}: point {key} in image {row['image']} is observed twice")
        seen.add(pair)
        image.append(pair[0])
        point.append(pair[1])
        if given and not override:
            sxx, sxy, syy = _numbers(where, row, covariance_columns)
            if not (sxx > 0 and syy > 0 and sxx * syy > sxy * sxy):
                raise InputError(f"{where}: expected a positive definite covariance, found {sxx}, {sxy}, {syy}")
            covariance.append([[sxx, sxy], [sxy, syy]])
        else:
            covariance.append([[variance, 0.0], [0.0, variance]])
    observations = Observations(
        image=np.array(image, dtype=np.int64),
        point=np.array(point, dtype=np.int64),
        xy_px=np.array(xy).reshape(-1, 2),
        covariance=np.array(covariance).reshape(-1, 2, 2),
    )
    return observations, given or override


def _point_of_tag(where: str, row: dict[str, str]) -> str:
    tag, corner = row["tag"], row["corner"]
    if not (tag.isdigit() and corner in ("0", "1", "2", "3")):
        raise InputError(f"{where}: expected a tag id and a corner 0 to 3, found {tag!r}, {corner!r}")
    return str(point3d_id(int(tag), int(corner)))


def read_control(path: Path, point_names: Sequence[str]) -> ControlPoints:
    """Read control points: point,x_mm,y_mm,z_mm,sigma_mm; sigma 0 = error-free.

    Raises:
        InputError: with file and line; an unknown or repeated point, a number that is not one, a negative sigma.
    """
    table = {name: index for index, name in enumerate(point_names)}
    columns = ("point", "x_mm", "y_mm", "z_mm", "sigma_mm")
    index, xyz, sigma = [], [], []
    for where, row in csv_rows(path, columns):
        index.append(_index(where, "control point", row["point"], table))
        values = _numbers(where, row, columns[1:])
        if values[3] < 0:
            raise InputError(f"{where}: sigma_mm: expected 0 (error-free) or more, found {values[3]}")
        if index[-1] in index[:-1]:
            raise InputError(f"{where}: control point {row['point']} stands in the list twice")
        xyz.append([value * MM for value in values[:3]])
        sigma.append(values[3] * MM)
    return ControlPoints(point=np.array(index, dtype=np.int64), xyz=np.reshape(xyz, (-1, 3)), sigma=np.array(sigma))


def read_scale_bars(path: Path, point_names: Sequence[str]) -> ScaleBars:
    """Read scale bars: a,b,length_mm,sigma_mm; sigma 0 = error-free.

    Raises:
        InputError: with file and line; an unknown point, a bar from a point to itself, a length that is not positive.
    """
    table = {name: index for index, name in enumerate(point_names)}
    columns = ("a", "b", "length_mm", "sigma_mm")
    ends, values = [], []
    for where, row in csv_rows(path, columns):
        pair = (_index(where, "scale bar end", row["a"], table), _index(where, "scale bar end", row["b"], table))
        length, sigma = _numbers(where, row, columns[2:])
        if pair[0] == pair[1]:
            raise InputError(f"{where}: expected two different points, found {row['a']} twice")
        if length <= 0 or sigma < 0:
            raise InputError(f"{where}: expected a positive length and a sigma of 0 or more, found {length}, {sigma}")
        ends.append(pair)
        values.append([length * MM, sigma * MM])
    both, numbers = np.array(ends, dtype=np.int64).reshape(-1, 2), np.reshape(values, (-1, 2))
    return ScaleBars(a=both[:, 0], b=both[:, 1], length=numbers[:, 0], sigma=numbers[:, 1])
