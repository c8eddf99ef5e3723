"""What carries the datum of an adjustment, as CSV: control.csv, scalebars.csv, poses.csv. Lengths are mm."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from netdesign.errors import InputError
from netdesign.files.csv_table import csv_rows, index_of, numbers
from netdesign.model.adjustment import ControlPoints, PosePriors, ScaleBars
from netdesign.model.arrays import Floats
from netdesign.model.frames import pose

MM = 1e-3
COORDINATES, AXIS_SIGMAS = ("x_mm", "y_mm", "z_mm"), ("sx_mm", "sy_mm", "sz_mm")


def read_control(path: Path, point_names: Sequence[str]) -> ControlPoints:
    """Read control points: point,x_mm,y_mm,z_mm and sigma_mm, or sx_mm,sy_mm,sz_mm for the axes one by one.

    Sigma 0: error-free, on all axes or none. An empty sigma says that the coordinate is not known, and it may be empty
    itself: a point known in plan or in height only. Where a row fills sx_mm, sy_mm or sz_mm, sigma_mm is not looked at.

    Raises:
        InputError: with file and line; an unknown or repeated point, a number that is not one, a negative sigma.
    """
    table = {name: index for index, name in enumerate(point_names)}
    index, xyz, sigma = [], [], []
    for where, row in csv_rows(path, ("point", *COORDINATES, "sigma_mm"), AXIS_SIGMAS):
        index.append(index_of(where, "control point", row["point"], table))
        if index[-1] in index[:-1]:
            raise InputError(f"{where}: control point {row['point']} stands in the list twice")
        sigma.append(_axis_sigmas(where, row))
        known = [row[name] != "" or np.isfinite(sigma[-1][axis]) for axis, name in enumerate(COORDINATES)]
        named = [name for name, is_known in zip(COORDINATES, known, strict=True) if is_known]
        values = dict(zip(named, numbers(where, row, named), strict=True))
        xyz.append([values.get(name, 0.0) * MM for name in COORDINATES])
    return ControlPoints(
        point=np.array(index, dtype=np.int64),
        xyz=np.reshape(xyz, (-1, 3)),
        sigma=np.reshape(sigma, (-1, 3)) * MM,
    )


def _axis_sigmas(where: str, row: dict[str, str]) -> list[float]:
    """Return the sigmas of a control point's coordinates in mm, infinite where nothing is known."""
    names = AXIS_SIGMAS if any(row.get(name) for name in AXIS_SIGMAS) else ("sigma_mm",) * 3
    values = [numbers(where, row, (name,))[0] if row.get(name) else float("inf") for name in names]
    for name, value in zip(names, values, strict=True):
        if value < 0:
            raise InputError(f"{where}: {name}: expected 0 (error-free) or more, found {value}")
    if not np.isfinite(values).any():
        raise InputError(f"{where}: expected a sigma for at least one coordinate of {row['point']}, found none")
    if 0.0 in values and any(values):
        raise InputError(f"{where}: expected sigma 0 (error-free) on all axes or on none, found {values}")
    return values


def read_scale_bars(path: Path, point_names: Sequence[str]) -> ScaleBars:
    """Read scale bars: a,b,length_mm,sigma_mm; sigma 0 = error-free.

    Raises:
        InputError: with file and line; an unknown point, a bar from a point to itself, a length that is not positive.
    """
    table = {name: index for index, name in enumerate(point_names)}
    columns = ("a", "b", "length_mm", "sigma_mm")
    ends, values = [], []
    for where, row in csv_rows(path, columns):
        pair = (index_of(where, "scale bar end", row["a"], table), index_of(where, "scale bar end", row["b"], table))
        length, sigma = numbers(where, row, columns[2:])
        if pair[0] == pair[1]:
            raise InputError(f"{where}: expected two different points, found {row['a']} twice")
        if length <= 0 or sigma < 0:
            raise InputError(f"{where}: expected a positive length and a sigma of 0 or more, found {length}, {sigma}")
        ends.append(pair)
        values.append([length * MM, sigma * MM])
    both, lengths = np.array(ends, dtype=np.int64).reshape(-1, 2), np.reshape(values, (-1, 2))
    return ScaleBars(a=both[:, 0], b=both[:, 1], length=lengths[:, 0], sigma=lengths[:, 1])


def read_pose_priors(
    path: Path, image_names: Sequence[str], world_from_cam: Floats, left_out: Collection[str] = ()
) -> PosePriors:
    """Read pose priors: image,sigma_position_mm,sigma_rotation_deg and, where known, x_mm,y_mm,z_mm,qx,qy,qz,qw.

    A robot's repeatability, a satellite receiver's position. An empty sigma says that the position or the rotation is
    not known; without coordinates or quaternion (of world_from_cam) those of images.txt are the prior.

    Args:
        world_from_cam: (n, 4, 4) m, approximate poses.  left_out: images that are not adjusted; their rows are skipped.

    Raises:
        InputError: with file and line.
    """
    table = {name: index for index, name in enumerate(image_names)}
    image: list[int] = []
    rows: list[Floats] = []
    sigma: list[list[float]] = []
    for where, row in csv_rows(path, ("image", "sigma_position_mm", "sigma_rotation_deg")):
        if row["image"] in left_out:
            continue
        index = index_of(where, "image", row["image"], table)
        if index in image:
            raise InputError(f"{where}: image {row['image']} stands in the list twice")
        image.append(index)
        sigma.append([_sigma(where, row, name) for name in ("sigma_position_mm", "sigma_rotation_deg")])
        position, rotation = world_from_cam[index, :3, 3], world_from_cam[index, :3, :3]
        if row.get("x_mm"):
            position = np.array(numbers(where, row, ("x_mm", "y_mm", "z_mm"))) * MM
        if row.get("qx"):
            quaternion = np.array(numbers(where, row, ("qx", "qy", "qz", "qw")))
            if not 0.99 < np.linalg.norm(quaternion) < 1.01:
                raise InputError(f"{where}: expected a unit quaternion qx,qy,qz,qw, found {quaternion.tolist()}")
            rotation = Rotation.from_quat(quaternion).as_matrix()
        rows.append(pose(rotation, position))
    sigmas = np.array(sigma).reshape(-1, 2)
    return PosePriors(
        world_from_cam=np.array(rows).reshape(-1, 4, 4),
        sigma_position=sigmas[:, 0] * MM,
        sigma_rotation=np.radians(sigmas[:, 1]),
        image=np.array(image, dtype=np.int64),
    )


def _sigma(where: str, row: dict[str, str], name: str) -> float:
    """Return a positive sigma, inf for an empty field."""
    if not row[name]:
        return float("inf")
    value = numbers(where, row, (name,))[0]
    if value <= 0:
        raise InputError(f"{where}: {name}: expected a positive number or nothing (not known), found {row[name]}")
    return value
