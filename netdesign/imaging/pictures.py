"""Image files: the same grey levels give the same bytes."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from netdesign.errors import InputError
from netdesign.model.camera import Camera

COMPRESSION = 1  # of 9: sensor noise does not compress, more effort only costs time


def png_bytes(picture: NDArray[np.generic]) -> bytes:
    """Return a grey picture (h, w) uint8 or uint16 as PNG."""
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION])
    return bytes(encoded)


def linear(picture: NDArray[np.generic], gamma: float) -> NDArray[np.uint16]:
    """Return a picture that was stored as level^(1/gamma) as 16-bit levels linear in light, which measuring needs.

    Args:
        gamma: 2.2 for most photographs; corners of a picture left as it is would shrink by 0.1 to 0.2 px.
    """
    full_scale = 65535 if picture.dtype == np.uint16 else 255
    table = np.rint(65535 * (np.arange(full_scale + 1) / full_scale) ** gamma).astype(np.uint16)
    return np.asarray(table[np.asarray(picture, np.int64)])


def read_picture(path: Path, camera: Camera | None = None) -> NDArray[np.generic]:
    """Read a picture as grey levels (h, w), uint8 or uint16; colour is averaged as OpenCV does.

    Raises:
        InputError: missing, no image, cut short, or not of the camera's size.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such image")
    content = path.read_bytes()
    if not _whole(content):
        raise InputError(f"{path}: expected an image of 8 or 16 bit, found one that is cut short or none")
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: expected an image of 8 or 16 bit, found something else")
    if camera is not None and picture.shape != (camera.height_px, camera.width_px):
        raise InputError(
            f"{path}: expected {camera.width_px} x {camera.height_px} px as the camera has, found "
            f"{picture.shape[1]} x {picture.shape[0]}"
        )
    return np.asarray(picture)


def _whole(content: bytes) -> bool:
    """Tell whether a PNG or JPEG has its end mark: OpenCV fills what is missing of a shorter one with grey.

    Cameras put data of their own behind the mark, and a preview with an end mark of its own before the picture.
    """
    if content.startswith(b"\x89PNG"):
        return b"IEND" in content
    if not content.startswith(b"\xff\xd8"):
        return True  # of another format; the decoder decides
    place = 2
    while place + 4 <= len(content) and content[place] == 0xFF:
        if content[place + 1] == 0xDA:  # the scan: inside it a byte ff is always followed by 00 or a restart mark
            return content.find(b"\xff\xd9", place) >= 0
        place += 2 + int.from_bytes(content[place + 2 : place + 4], "big")
    return False
