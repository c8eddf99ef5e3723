"""COLMAP's text model as users and other programs write it: numbers by line, with the line in every complaint.

Read here rather than by pycolmap, whose reader cuts image names at a space, keeps the carriage return of Windows line
ends, and answers a malformed line by an exception without a line number or by ending the process. Accepted besides
what COLMAP writes itself: images without their POINTS2D line, comments anywhere, tracks left out of points3D.txt.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netdesign.errors import InputError
from netdesign.model.arrays import Floats, Ints

NO_POINT = (-1, 2**64 - 1)  # POINT3D_ID of an image point that belongs to no object point, in either spelling


@dataclass(frozen=True, kw_only=True)
class CameraLine:
    """One camera: its id, model name, size in pixels, parameters in COLMAP's order, and where it stands."""

    camera_id: int
    model: str
    size: tuple[int, int]
    parameters: tuple[float, ...]
    where: str


@dataclass(frozen=True, kw_only=True)
class ImageLine:
    """One image: name, quaternion (w, x, y, z) and translation of cam_from_world, POINTS2D.

    Attributes:
        xy: (k, 2) in COLMAP's pixel origin.  point_id: (k,) POINT3D_ID, without those that belong to no point.
    """

    name: str
    camera_id: int
    quaternion: Floats
    translation: Floats
    xy: Floats
    point_id: Ints
    where: str


def read_cameras(path: Path, parameter_counts: dict[str, int]) -> tuple[CameraLine, ...]:
    """Return the cameras by ascending id.

    Args:
        parameter_counts: number of parameters by model name; other models are refused.

    Raises:
        InputError: with the line.
    """
    cameras: dict[int, CameraLine] = {}
    for where, line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < 2 or words[1] not in parameter_counts:
            known = ", ".join(parameter_counts)
            raise InputError(f"{where}: expected a camera model of {known}, found {' '.join(words[1:2])!r}")
        count = parameter_counts[words[1]]
        camera_id, values = _integers(words[:1]), _floats(words[2:])
        if camera_id is None or values is None or len(values) != 2 + count:
            raise InputError(f"{where}: expected id, model, width, height and {count} numbers, found {line!r}")
        focal_lengths = 2 if words[1] in ("PINHOLE", "OPENCV") else 1
        if (values[: 2 + focal_lengths] <= 0).any():
            raise InputError(f"{where}: expected a positive size and focal length, found {line!r}")
        number = int(camera_id[0])
        if number in cameras:
            raise InputError(f"{where}: camera {number} stands in the file twice")
        cameras[number] = CameraLine(
            camera_id=number,
            model=words[1],
            size=(int(values[0]), int(values[1])),
            parameters=tuple(values[2:].tolist()),
            where=where,
        )
    return tuple(cameras[number] for number in sorted(cameras))


def read_images(path: Path) -> tuple[ImageLine, ...]:
    """Return the images in the order of the file.

    Raises:
        InputError: with the line.
    """
    images: list[ImageLine] = []
    head: tuple[str, list[str]] | None = None
    empty: tuple[Floats, Ints] = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    for where, line in _lines(path):
        if head is not None:
            points = _points2d(line)
            if points is not None:
                wrong = points[0][~np.isfinite(points[0])]
                if len(wrong):
                    raise InputError(f"{where}: expected finite numbers, found {wrong[0]}")
                images.append(_image(*head, *points))
                head = None
                continue
            if _floats(line.split()[:8]) is None or len(line.split()) < 10:
                raise InputError(f"{where}: expected POINTS2D of {head[1][9]} as x y POINT3D_ID …, found {line[:60]!r}")
            images.append(_image(*head, *empty))  # its POINTS2D line was left out
            head = None
        if line:
            head = where, _image_words(where, line)
    return tuple(images) if head is None else (*images, _image(*head, *empty))


def read_points(path: Path) -> tuple[Ints, Floats]:
    """Return POINT3D_IDs (m,), ascending, and coordinates (m, 3).

    Raises:
        InputError: with the line.
    """
    found: dict[int, Floats] = {}
    for where, line in _lines(path):
        words = line.split()
        if not words:
            continue
        number, xyz = _integers(words[:1]), _floats(words[1:4])
        if number is None or xyz is None or len(xyz) < 3 or number[0] < 0:
            raise InputError(f"{where}: expected POINT3D_ID x y z as finite numbers, found {line[:60]!r}")
        if int(number[0]) in found:
            raise InputError(f"{where}: point {int(number[0])} stands in the file twice")
        found[int(number[0])] = xyz
    ids = sorted(found)
    return np.array(ids, dtype=np.int64), np.array([found[number] for number in ids]).reshape(-1, 3)


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield ("file:line", text without surrounding blanks) of every line that is no comment.

    Raises:
        InputError: the file is not text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected UTF-8 text, found {error.reason} at byte {error.start}") from None
    lines = text.split("\n")  # read_text has turned every line end into this one
    if lines[-1] == "":
        lines.pop()
    for number, line in enumerate(lines, start=1):
        stripped = line.strip()
        if not stripped.startswith("#"):
            yield f"{path}:{number}", stripped


def _image_words(where: str, line: str) -> list[str]:
    """Return IMAGE_ID, qw qx qy qz, tx ty tz, CAMERA_ID and the name, which may contain blanks."""
    words = line.split(maxsplit=9)
    if len(words) < 10:
        raise InputError(
            f"{where}: expected IMAGE_ID, qw qx qy qz, tx ty tz, CAMERA_ID and a name, found {len(words)} words"
        )
    return words


def _image(where: str, words: list[str], xy: Floats, point_id: Ints) -> ImageLine:
    values, camera_id = _floats(words[1:8]), _integers(words[8:9])
    if values is None:
        wrong = next(word for word in words[1:8] if _floats([word]) is None)
        raise InputError(f"{where}: expected finite numbers for the pose, found {wrong}")
    if camera_id is None:
        raise InputError(f"{where}: expected a CAMERA_ID, found {words[8]!r}")
    length = float(np.linalg.norm(values[:4]))
    if length < 1e-6:
        raise InputError(f"{where}: expected a quaternion, found one of length {length:.3g}")
    return ImageLine(
        name=words[9],
        camera_id=int(camera_id[0]),
        quaternion=values[:4] / length,
        translation=values[4:],
        xy=xy,
        point_id=point_id,
        where=where,
    )


def _points2d(line: str) -> tuple[Floats, Ints] | None:
    """Return coordinates (k, 2) and POINT3D_IDs (k,) of a POINTS2D line, None for a line that is none.

    NaN and infinity pass: the caller complains.
    """
    words = line.split()
    if len(words) % 3:
        return None
    ids = _integers(words[2::3])
    if ids is None:
        return None
    try:
        xy = np.array([[float(word) for word in words[0::3]], [float(word) for word in words[1::3]]]).T.reshape(-1, 2)
    except ValueError:
        return None
    belongs = ids >= 0
    return xy[belongs], ids[belongs]


def _floats(words: Sequence[str]) -> Floats | None:
    """Return finite numbers, or None."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def _integers(words: Sequence[str]) -> Ints | None:
    """Return whole numbers, -1 for NO_POINT, or None."""
    try:
        values = [int(word) for word in words]
    except ValueError:
        return None
    return np.array([-1 if value in NO_POINT else value for value in values], dtype=np.int64)
