"""COLMAP text models: the only file that meets pycolmap.

Two conventions are converted here and nowhere else: COLMAP's pixel origin (top-left pixel centre at (0.5, 0.5)) to ours
(0, 0), and cam_from_world to world_from_cam. Lengths in the files are mm, inside they are metres.
"""

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from netdesign.errors import InputError
from netdesign.files.store import write_bytes
from netdesign.model.arrays import Floats, Ints, frozen
from netdesign.model.camera import Camera
from netdesign.model.frames import inverse, pose

MODEL_FILES = ("cameras.txt", "images.txt", "points3D.txt")
PIXEL_ORIGIN = 0.5
MM = 1e-3

# Where each model keeps fx, fy, cx, cy, k1, k2, p1, p2 among its parameters; None: zero.
PARAMETERS: dict[str, tuple[int | None, ...]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2, None, None, None, None),
    "PINHOLE": (0, 1, 2, 3, None, None, None, None),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """A COLMAP model in our conventions; images sorted by name, points by id.

    Attributes:
        cameras: one per COLMAP camera.  camera_ids: their COLMAP ids.  camera_of_image: (n,) index into ``cameras``.
        names: (n,) image names.  world_from_cam: (n, 4, 4) m.
        point_ids: (m,) POINT3D_IDs.  points: (m, 3) m.
        image, point: (k,) indices of the observations.  xy_px: (k, 2), origin (0, 0).
    """

    cameras: tuple[Camera, ...]
    camera_ids: tuple[int, ...]
    camera_of_image: Ints
    names: tuple[str, ...]
    world_from_cam: Floats
    point_ids: tuple[int, ...]
    points: Floats
    image: Ints
    point: Ints
    xy_px: Floats

    def __post_init__(self) -> None:
        count, points = len(self.names), len(self.point_ids)
        object.__setattr__(self, "camera_of_image", frozen("camera_of_image", self.camera_of_image, (count,), np.int64))
        object.__setattr__(self, "world_from_cam", frozen("world_from_cam", self.world_from_cam, (count, 4, 4)))
        object.__setattr__(self, "points", frozen("points", self.points, (points, 3)))
        object.__setattr__(self, "image", frozen("image", self.image, ("k",), np.int64))
        object.__setattr__(self, "point", frozen("point", self.point, (len(self.image),), np.int64))
        object.__setattr__(self, "xy_px", frozen("xy_px", self.xy_px, (len(self.image), 2)))


def point3d_id(tag_id: int, corner: int) -> int:
    """Return the POINT3D_ID that our models give to a tag corner: 4 tag + corner + 1."""
    return 4 * tag_id + corner + 1


def write_model(folder: Path, model: ColmapModel) -> None:
    """Write cameras.txt, images.txt and points3D.txt (and COLMAP's rigs.txt and frames.txt) into ``folder``.

    Cameras are written as OPENCV, image ids count from 1 in the order of ``model.names``.
    """
    reconstruction = pycolmap.Reconstruction()
    for camera_id, camera in zip(model.camera_ids, model.cameras, strict=True):
        parameters = camera.intrinsics.copy()
        parameters[2:4] += PIXEL_ORIGIN
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=camera_id, model="OPENCV", width=camera.width_px, height=camera.height_px, params=parameters
            )
        )
    for point_id, xyz in zip(model.point_ids, model.points, strict=True):
        reconstruction.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=xyz / MM))
    cam_from_world = inverse(model.world_from_cam)
    for index, name in enumerate(model.names):
        rows = np.flatnonzero(model.image == index)
        image = pycolmap.Image(
            name=name,
            keypoints=model.xy_px[rows] + PIXEL_ORIGIN,
            camera_id=model.camera_ids[model.camera_of_image[index]],
            image_id=index + 1,
        )
        placed = pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world[index, :3, :3]), cam_from_world[index, :3, 3] / MM)
        reconstruction.add_image_with_trivial_frame(image, placed)
        for position, row in enumerate(rows):
            element = pycolmap.TrackElement(image_id=index + 1, point2D_idx=position)
            reconstruction.add_observation(model.point_ids[model.point[row]], element)
    with tempfile.TemporaryDirectory() as scratch:
        reconstruction.write_text(scratch)
        for path in sorted(Path(scratch).iterdir()):
            write_bytes(folder / path.name, path.read_bytes())


def read_model(folder: Path) -> ColmapModel:
    """Read a COLMAP text model.

    Raises:
        InputError: a file is missing or malformed, or a camera model is not one of ``PARAMETERS``.
    """
    for name in MODEL_FILES:
        if not (folder / name).is_file():
            raise InputError(f"{folder}: expected a COLMAP text model, found no {name}")
    _check_cameras(folder / "cameras.txt")
    reconstruction = pycolmap.Reconstruction()
    with _quiet():
        try:
            reconstruction.read_text(str(folder))
        except (RuntimeError, ValueError, IndexError, OverflowError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{folder}: expected a COLMAP text model, COLMAP says: {reason}") from None
    camera_ids = tuple(sorted(reconstruction.cameras))
    images = sorted(reconstruction.images.values(), key=lambda image: image.name)
    point_ids = tuple(sorted(reconstruction.points3D))
    row_of_point = {point_id: row for row, point_id in enumerate(point_ids)}
    rows = [
        (index, row_of_point[point2d.point3D_id], *point2d.xy)
        for index, image in enumerate(images)
        for point2d in image.points2D
        if point2d.has_point3D()
    ]
    observed = np.array(rows, dtype=np.float64).reshape(-1, 4)
    cam_from_world = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    placed = pose(cam_from_world[:, :, :3], cam_from_world[:, :, 3] * MM)
    return ColmapModel(
        cameras=tuple(_camera(reconstruction.cameras[camera_id]) for camera_id in camera_ids),
        camera_ids=camera_ids,
        camera_of_image=np.array([camera_ids.index(image.camera_id) for image in images], dtype=np.int64),
        names=tuple(image.name for image in images),
        world_from_cam=inverse(placed),
        point_ids=point_ids,
        points=np.array([reconstruction.points3D[point_id].xyz for point_id in point_ids]).reshape(-1, 3) * MM,
        image=observed[:, 0].astype(np.int64),
        point=observed[:, 1].astype(np.int64),
        xy_px=observed[:, 2:] - PIXEL_ORIGIN,
    )


def _camera(camera: pycolmap.Camera) -> Camera:
    """Return our camera of a COLMAP one whose model has been checked."""
    fx, fy, cx, cy, *distortion = (
        0.0 if index is None else float(camera.params[index]) for index in PARAMETERS[camera.model.name]
    )
    return Camera(
        width_px=camera.width,
        height_px=camera.height,
        focal_px=np.array([fx, fy]),
        principal_point_px=np.array([cx, cy]) - PIXEL_ORIGIN,
        distortion=np.array(distortion),
    )


def _check_cameras(path: Path) -> None:
    """Raise InputError for a camera line that COLMAP would answer by ending the process."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        known = ", ".join(PARAMETERS)
        if len(words) < 2 or words[1] not in PARAMETERS:
            raise InputError(f"{path}:{number}: expected a camera model of {known}, found {' '.join(words[1:2])!r}")
        expected = 1 + max(index for index in PARAMETERS[words[1]] if index is not None)
        try:
            values = [float(word) for word in words[2:]]
        except ValueError:
            values = []
        if len(values) != 2 + expected or not np.isfinite(values).all():
            raise InputError(f"{path}:{number}: expected width, height and {expected} numbers, found {line.strip()!r}")
        if values[0] <= 0 or values[1] <= 0 or values[2] <= 0:
            raise InputError(f"{path}:{number}: expected a positive size and focal length, found {line.strip()!r}")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's own log off the user's terminal."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
