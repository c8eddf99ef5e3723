"""AprilTags as cell patterns and textures; the bits come from OpenCV's dictionary.

A tag36h11 is 8 x 8 cells: a black border one cell wide around 6 x 6 data bits; other families have other numbers of
cells. It needs one cell of white around it, the quiet zone. Tag coordinates (u, v) count cells from the top-left corner
of the black square, u to the right and v down as OpenCV draws the tag: object points 0 to 3 are (0, 0), (n, 0), (n, n),
(0, n) for n cells.
"""

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError
from netdesign.model.scene import FAMILIES

QUIET_CELLS = 1  # white, on every side
ROW_BYTES = 4  # OpenGL wants the rows of a texture in multiples of it
DICTIONARIES = {
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
}


@lru_cache(maxsize=4)
def dictionary(family: str) -> "cv2.aruco.Dictionary":
    """Return OpenCV's dictionary of a tag family.

    Raises:
        InputError: the family is not known.
    """
    if family not in DICTIONARIES:
        raise InputError(f"targets.family: expected one of {', '.join(DICTIONARIES)}, found {family}")
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[family])


@lru_cache(maxsize=1024)
def cells(family: str, tag_id: int) -> NDArray[np.uint8]:
    """Return the (n, n) cells of a tag, row 0 at the top: 1 white, 0 black.

    Raises:
        InputError: the family has no such id.
    """
    known = len(dictionary(family).bytesList)
    if not 0 <= tag_id < known:
        raise InputError(f"tag id: {family} has ids 0 to {known - 1}, found {tag_id}")
    drawing = cv2.aruco.generateImageMarker(dictionary(family), tag_id, FAMILIES[family].cells, borderBits=1)
    pattern: NDArray[np.uint8] = (np.asarray(drawing) > 127).astype(np.uint8)
    pattern.setflags(write=False)
    return pattern


def texture(family: str, tag_id: int, padding: int, black: float, white: float) -> NDArray[np.uint8]:
    """Return the tag with its quiet zone as a square grey picture, the same few texels per cell, row 0 at the top.

    Args:
        padding: more white cells around the quiet zone.  black, white: linear levels in [0, 1].
    """
    rim = QUIET_CELLS + padding
    pattern = cells(family, tag_id)
    side = len(pattern) + 2 * rim
    levels = np.full((side, side), round(255 * white), np.uint8)
    levels[rim:-rim, rim:-rim] = np.where(pattern == 1, round(255 * white), round(255 * black))
    texels = ROW_BYTES // math.gcd(side, ROW_BYTES)
    return levels.repeat(texels, axis=0).repeat(texels, axis=1)
