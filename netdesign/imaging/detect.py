"""Finding tags with OpenCV: ids, corner seeds, and the camera's pose from one tag.

The only file, with ``tags.py``, that meets cv2. OpenCV counts pixels from the centre of the top-left pixel as we do
and lists corners in the order of its own drawing of the tag: top-left, top-right, bottom-right, bottom-left, our
order. (Its APRILTAG corner refinement is the exception, half a pixel off; it is not used.)

The seeds are 0.1 to 0.6 px off, towards the tag's centre; ``fit.py`` does the measuring.
"""

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from netdesign.imaging.tags import dictionary
from netdesign.model.arrays import Floats
from netdesign.model.frames import inverse, pose

# OpenCV's default, 3 % of the longer side, hides tags below 31 px in a 4096 px picture.
SMALLEST_PERIMETER_PX = 40.0
# The outline of a tag's quiet zone is a square too, and OpenCV takes outlines together that are nearer than a share of
# their length. Too little, and one of sixty large tags is lost to its own quiet zone, always the same one; too much,
# and one of fifteen others is. No tag seen yet is lost to both, so each search has one of them.
TOGETHER, APART = 0.125, 0.02
DARK = 100.0  # of 255: below it a picture is stretched before the search


@dataclass(frozen=True, kw_only=True)
class Sighted:
    """A tag that was recognised: its id and its corners (4, 2) in px, good to about 0.6 px."""

    tag_id: int
    corners_px: Floats


def detect(picture: NDArray[np.generic], family: str, ids: Collection[int] | None = None) -> list[Sighted]:
    """Return the tags of a picture, by id; a tag that shows twice is returned twice.

    Args:
        picture: (h, w) uint8 or uint16; how bright it is does not matter.
        ids: the ids that may occur; others are left out. None: every id of the family.

    Raises:
        InputError: the family is not known.
    """
    grey = _eight_bits(picture)
    sighted: list[Sighted] = []
    for item in _recognised(grey, family, ids, TOGETHER):
        _add(item, sighted)
    if ids is None or len({item.tag_id for item in sighted}) < len(ids):
        # Once more, enlarged: cells of about 2 px lose bits at the original size, and noise breaks other outlines.
        large = cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        for item in _recognised(np.asarray(large), family, ids, APART):
            # Pixel centres: the enlarged picture has its first sample at -0.25.
            _add(Sighted(tag_id=item.tag_id, corners_px=item.corners_px / 2 - 0.25), sighted)
    return sorted(sighted, key=lambda item: (item.tag_id, *item.corners_px.ravel().tolist()))


def _eight_bits(picture: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return the picture in 8 bits; 16-bit and dark ones stretched by a square root, which keeps the dark apart."""
    bright = float(np.quantile(np.asarray(picture[::4, ::4], np.float64), 0.995)) if picture.size else 0.0
    if picture.dtype == np.uint8 and bright >= DARK:
        return np.ascontiguousarray(picture, np.uint8)
    level = np.arange(65536 if picture.dtype == np.uint16 else 256) / max(bright, 1.0)
    table = np.rint(255 * np.sqrt(np.minimum(level, 1.0))).astype(np.uint8)
    return np.ascontiguousarray(table[np.asarray(picture)])


def _recognised(grey: NDArray[np.generic], family: str, ids: Collection[int] | None, distance: float) -> list[Sighted]:
    corners, found, _ = _detector(family, max(grey.shape), distance).detectMarkers(grey)
    if found is None:
        return []
    return [
        Sighted(tag_id=int(tag), corners_px=np.asarray(quad, np.float64).reshape(4, 2))
        for tag, quad in zip(np.asarray(found).ravel(), corners, strict=True)
        if ids is None or int(tag) in ids
    ]


def _add(item: Sighted, sighted: list[Sighted]) -> None:
    """Add a sighting unless the same tag, same id and centres closer than half an edge, is there already."""
    for known in sighted:
        edge = float(np.linalg.norm(known.corners_px[1] - known.corners_px[0]))
        apart = float(np.linalg.norm(item.corners_px.mean(axis=0) - known.corners_px.mean(axis=0)))
        if item.tag_id == known.tag_id and apart < 0.5 * edge:
            return
    sighted.append(item)


def _detector(family: str, longer_side: int, distance: float) -> "cv2.aruco.ArucoDetector":
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementWinSize = 3
    settings.relativeCornerRefinmentWinSize = 0.3
    settings.minMarkerPerimeterRate = SMALLEST_PERIMETER_PX / longer_side
    settings.minCornerDistanceRate = 0.02
    settings.minMarkerDistanceRate = distance
    settings.errorCorrectionRate = 0.4
    return cv2.aruco.ArucoDetector(dictionary(family), settings)


def pose_from_tag(corners_px: Floats, size_m: float, intrinsics: Floats) -> list[tuple[Floats, float]]:
    """Return the poses of a camera that sees one square tag, best first.

    A nearly frontal tag has two; source: T. Collins and A. Bartoli, IJCV 109, 2014 (OpenCV's IPPE_SQUARE).

    Args:
        corners_px: (4, 2), order TL, TR, BR, BL.  size_m: edge of the black square.  intrinsics: (8,).

    Returns:
        Pairs of tag_from_cam (4, 4), the tag frame at the tag's centre with x right, y up, z outward, and the rms
        reprojection error in px.
    """
    half = 0.5 * size_m
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    fx, fy, cx, cy = intrinsics[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    _, rotations, translations, errors = cv2.solvePnPGeneric(
        square, np.ascontiguousarray(corners_px, np.float64), matrix, np.asarray(intrinsics[4:], np.float64),
        flags=cv2.SOLVEPNP_IPPE_SQUARE,
    )  # fmt: skip
    poses = []
    for rotation, translation, error in zip(rotations, translations, np.ravel(errors), strict=True):
        cam_from_tag = pose(np.asarray(cv2.Rodrigues(rotation)[0], np.float64), np.ravel(translation))
        poses.append((inverse(cam_from_tag), float(error)))
    return sorted(poses, key=lambda item: item[1])
