"""COLMAP text models: the only file that meets pycolmap, which writes them; ``colmap_text`` reads.

Two conventions are converted here and nowhere else: COLMAP's pixel origin (top-left pixel centre at (0.5, 0.5)) to ours
(0, 0), and cam_from_world to world_from_cam. Lengths in the files are mm, inside they are metres.
"""

import signal
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from netdesign.errors import InputError
from netdesign.files.colmap_text import CameraLine, ImageLine, read_cameras, read_images, read_points
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
    pycolmap = _pycolmap()
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


def read_model(folder: Path, with_points2d: bool = True) -> ColmapModel:
    """Read a COLMAP text model.

    Args:
        with_points2d: False leaves the image points out; their POINT3D_IDs need not exist then.

    Raises:
        InputError: a file is missing or malformed, or a camera model is not one of ``PARAMETERS``.
    """
    for name in MODEL_FILES:
        if not (folder / name).is_file():
            raise InputError(f"{folder}: expected a COLMAP text model, found no {name}")
    counts = {name: 1 + max(index for index in row if index is not None) for name, row in PARAMETERS.items()}
    cameras = {line.camera_id: line for line in read_cameras(folder / "cameras.txt", counts)}
    images = sorted(read_images(folder / "images.txt"), key=lambda image: image.name)
    for image in images:
        if image.camera_id not in cameras:
            raise InputError(f"{image.where}: camera {image.camera_id} of image {image.name} is not in cameras.txt")
    # A camera that took no image has nothing to be adjusted from.
    used = sorted({image.camera_id for image in images})
    point_ids, points = read_points(folder / "points3D.txt")
    image_index, point_index, xy = _image_points(images if with_points2d else [], point_ids)
    quaternion = np.array([image.quaternion for image in images]).reshape(-1, 4)
    translation = np.array([image.translation for image in images]).reshape(-1, 3)
    rotation = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix() if images else np.zeros((0, 3, 3))
    return ColmapModel(
        cameras=tuple(_camera(cameras[camera_id]) for camera_id in used),
        camera_ids=tuple(used),
        camera_of_image=np.array([used.index(image.camera_id) for image in images], dtype=np.int64),
        names=tuple(image.name for image in images),
        world_from_cam=inverse(pose(rotation, translation * MM)),
        point_ids=tuple(point_ids.tolist()),
        points=points * MM,
        image=image_index,
        point=point_index,
        xy_px=xy - PIXEL_ORIGIN,
    )


def _image_points(images: Sequence[ImageLine], point_ids: Ints) -> tuple[Ints, Ints, Floats]:
    """Return image index (k,), point index (k,) and coordinates (k, 2) of all POINTS2D.

    Raises:
        InputError: an image point of an object point that is not in points3D.txt.
    """
    if not images:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    image = np.repeat(np.arange(len(images)), [len(line.point_id) for line in images])
    wanted = np.concatenate([line.point_id for line in images])
    row = np.searchsorted(point_ids, wanted)
    missing = np.flatnonzero(~np.isin(wanted, point_ids))
    if len(missing):
        line = images[int(image[missing[0]])]
        raise InputError(f"{line.where}: point {wanted[missing[0]]} of image {line.name} is not in points3D.txt")
    return image, row.astype(np.int64), np.concatenate([line.xy for line in images])


def _camera(line: CameraLine) -> Camera:
    """Return our camera of a COLMAP one."""
    fx, fy, cx, cy, *distortion = (0.0 if index is None else line.parameters[index] for index in PARAMETERS[line.model])
    return Camera(
        width_px=line.size[0],
        height_px=line.size[1],
        focal_px=np.array([fx, fy]),
        principal_point_px=np.array([cx, cy]) - PIXEL_ORIGIN,
        distortion=np.array(distortion),
    )


def _pycolmap() -> Any:
    """Import pycolmap and take SIGTERM back: it would answer with a stack trace instead of keeping what is done."""
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap
