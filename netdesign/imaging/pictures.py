"""Image files: the same grey levels give the same bytes."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError

COMPRESSION = 1  # of 9: sensor noise does not compress, more effort only costs time


def png_bytes(picture: NDArray[np.generic]) -> bytes:
    """Return a grey picture (h, w) uint8 or uint16 as PNG."""
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION])
    return bytes(encoded)


def read_picture(path: Path) -> NDArray[np.generic]:
    """Read a picture as grey levels (h, w), uint8 or uint16; colour is averaged as OpenCV does.

    Raises:
        InputError: missing or no image.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such image")
    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: expected an image of 8 or 16 bit, found something else")
    return np.asarray(picture)
