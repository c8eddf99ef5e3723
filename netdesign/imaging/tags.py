"""AprilTags as cell patterns and textures; the bits come from OpenCV's dictionary.

A tag36h11 is 8 x 8 cells: a black border one cell wide around 6 x 6 data bits. It needs one cell of white around
it, the quiet zone. Tag coordinates (u, v) count cells from the top-left corner of the black square, u to the right
and v down as OpenCV draws the tag: object points 0 to 3 are (0, 0), (8, 0), (8, 8), (0, 8).
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError

CELLS = 8  # along the black square, border included
QUIET_CELLS = 1  # white, on every side
FAMILIES = {"tag36h11": cv2.aruco.DICT_APRILTAG_36h11}


@lru_cache(maxsize=4)
def dictionary(family: str) -> "cv2.aruco.Dictionary":
    """Return OpenCV's dictionary of a tag family.

    Raises:
        InputError: the family is not known.
    """
    if family not in FAMILIES:
        raise InputError(f"targets.family: expected one of {', '.join(FAMILIES)}, found {family}")
    return cv2.aruco.getPredefinedDictionary(FAMILIES[family])


@lru_cache(maxsize=1024)
def cells(family: str, tag_id: int) -> NDArray[np.uint8]:
    """Return the (8, 8) cells of a tag, row 0 at the top: 1 white, 0 black.

    Raises:
        InputError: the family has no such id.
    """
    known = len(dictionary(family).bytesList)
    if not 0 <= tag_id < known:
        raise InputError(f"tag id: {family} has ids 0 to {known - 1}, found {tag_id}")
    drawing = cv2.aruco.generateImageMarker(dictionary(family), tag_id, CELLS, borderBits=1)
    pattern: NDArray[np.uint8] = (np.asarray(drawing) > 127).astype(np.uint8)
    pattern.setflags(write=False)
    return pattern


def texture(family: str, tag_id: int, padding: int, black: float, white: float) -> NDArray[np.uint8]:
    """Return the tag with its quiet zone as a square grey picture, one texel per cell, row 0 at the top.

    Args:
        padding: more white cells around the quiet zone.  black, white: linear levels in [0, 1].
    """
    rim = QUIET_CELLS + padding
    levels = np.full((CELLS + 2 * rim,) * 2, round(255 * white), np.uint8)
    levels[rim:-rim, rim:-rim] = np.where(cells(family, tag_id) == 1, round(255 * white), round(255 * black))
    return levels
