"""The detector's noise model as written by ``netdesign calibrate-noise`` (kind noise)."""

from importlib.resources import as_file, files
from pathlib import Path

from netdesign.errors import InputError
from netdesign.files.store import read_json
from netdesign.model.camera import CornerNoise
from netdesign.model.scene import FAMILIES


def read_corner_noise(path: Path | None, family: str) -> CornerNoise:
    """Read a calibration for a family of tags; None takes the one that is shipped.

    Raises:
        InputError: missing, of another kind, for another family, or without positive k and floor_px.
    """
    if path is None:
        with as_file(files("netdesign.imaging") / f"noise_{family}.json") as shipped:
            content = read_json(shipped, "noise")
    else:
        content = read_json(path, "noise")
    calibrated = content.get("family", "tag36h11")
    if calibrated != family:
        raise InputError(f"{path}: expected a calibration with {family} (targets.family), found one with {calibrated}")
    k, floor = content.get("k"), content.get("floor_px")
    if not (isinstance(k, int | float) and isinstance(floor, int | float) and k > 0 and floor >= 0):
        raise InputError(f"{path}: expected positive k and floor_px, found k = {k!r}, floor_px = {floor!r}")
    return CornerNoise(k=float(k), floor_px=float(floor), cells=FAMILIES[family].cells)
