"""Observation sets: a COLMAP text model, with its image points or with an observations.csv beside it.

Pixels in observations.csv count from the centre of the top-left pixel. A network folder of a run is an observation set
too: its observations.csv names tag and corner instead of the point. What carries the datum is in ``datum_tables``.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from netdesign.adjustment.problem import BundleProblem
from netdesign.errors import InputError
from netdesign.files.colmap import point3d_id, read_model
from netdesign.files.csv_table import csv_rows, index_of, numbers
from netdesign.model.arrays import Floats, Ints
from netdesign.model.network import Observations

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

    def problem(self) -> BundleProblem:
        """Return the adjustment of the set in the usual datum, nothing refined, without control, bars or priors."""
        return BundleProblem(
            observations=self.observations,
            camera_of_image=self.camera_of_image,
            intrinsics=self.intrinsics,
            world_from_cam=self.world_from_cam,
            points=self.points,
            image_names=self.image_names,
            point_names=self.point_names,
        )

    def without_blind_images(self) -> tuple["ObservationSet", tuple[str, ...]]:
        """Return the set without the images that have no image point (and their cameras), and their names."""
        seen = np.bincount(self.observations.image, minlength=len(self.image_names)) > 0
        if seen.all():
            return self, ()
        cameras, camera_of_image = np.unique(self.camera_of_image[seen], return_inverse=True)
        row = np.cumsum(seen) - 1
        kept = replace(
            self,
            image_names=tuple(name for name, keep in zip(self.image_names, seen, strict=True) if keep),
            world_from_cam=self.world_from_cam[seen],
            intrinsics=self.intrinsics[cameras],
            camera_of_image=camera_of_image.astype(np.int64),
            observations=replace(self.observations, image=row[self.observations.image].astype(np.int64)),
        )
        return kept, tuple(name for name, keep in zip(self.image_names, seen, strict=True) if not keep)


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
    repeated = [a for a, b in itertools.pairwise(model.names) if a == b]
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


def _read_observations(
    path: Path, names: Sequence[str], point_ids: Sequence[int], variance: float, override: bool
) -> tuple[Observations, bool]:
    """Return the observations and whether their noise is known; ``override`` puts ``variance`` in its place."""
    rows = csv_rows(path, ["image", "x_px", "y_px"])
    by_tag = bool(rows) and "point" not in rows[0][1] and {"tag", "corner"} <= set(rows[0][1])
    if rows and not by_tag and "point" not in rows[0][1]:
        raise InputError(f"{path}:1: expected columns image,point,x_px,y_px, found no point")
    covariance_columns = ["sxx_px2", "sxy_px2", "syy_px2"]
    given = bool(rows) and all(name in rows[0][1] for name in covariance_columns)
    images = {name: index for index, name in enumerate(names)}
    points = {str(number): index for index, number in enumerate(point_ids)}
    image, point, xy, covariance = [], [], [], []
    seen: set[tuple[int, int]] = set()
    for where, row in rows:
        key = row["point"] if not by_tag else _point_of_tag(where, row)
        pair = index_of(where, "image", row["image"], images), index_of(where, "point", key, points)
        xy.append(numbers(where, row, ["x_px", "y_px"]))
        if pair in seen:
            raise InputError(f"{where}: point {key} in image {row['image']} is observed twice")
        seen.add(pair)
        image.append(pair[0])
        point.append(pair[1])
        if given and not override:
            sxx, sxy, syy = numbers(where, row, covariance_columns)
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
