"""What stands beside the pictures of a synthetic image set: camera.toml, targets.csv and the README of the folder."""

from pathlib import Path

from netdesign.files.calibrators import camera_toml, targets_csv
from netdesign.files.store import write_text
from netdesign.model.camera import Camera
from netdesign.model.scene import Targets

WIDTH = 36  # of the column with the names
CONTENTS = (
    (("images",), "images/*.png", "grey, {bits} bit, linear in light"),
    (("truth.json",), "truth.json", "exact poses, points (mm) and corner coordinates per image"),
    (("corners.csv",), "corners.csv", "the same corner coordinates as a table"),
    (("cameras.txt", "images.txt", "points3D.txt"), "cameras.txt images.txt points3D.txt",
     "the truth as a COLMAP text model (pixel origin 0.5, lengths in mm)"),
    (("frames.txt", "rigs.txt"), "frames.txt rigs.txt", "its rig of one camera, for newer versions of COLMAP"),
    (("camera.toml", "targets.csv"), "camera.toml targets.csv",
     "the camera and the tags (centre, normal, x axis in mm): `netdesign adjust` on\n"
     "this folder measures the photographs and starts from these"),
    (("faults.csv",), "faults.csv", "the tags that show the id of another, per image"),
    (("camchain.yaml",), "camchain.yaml", "the camera for Kalibr"),
    (("aprilgrid.yaml",), "aprilgrid.yaml",
     "the tags as Kalibr's grid. Our tags have a black border of one cell; Kalibr's own\n"
     "grids, and by default its detector (blackTagBorder), have two"),
    (("camera-opencv.yaml",), "camera-opencv.yaml", "the camera for OpenCV's FileStorage"),
    (("depth",), "depth/*.npy", "depth along the optical axis per pixel, float32, m; 0: nothing there"),
    (("masks",), "masks/*.png", "tag id + 1 per pixel, 16 bit; 0: no tag"),
)  # fmt: skip
AXES = """
Pixel origin: the centre of the top-left pixel is (0, 0), except in the COLMAP model. Camera axes: x right, y down,
z forward. Corners 0 to 3: top-left, top-right, bottom-right, bottom-left of the black square as OpenCV draws the tag.
"""


def complete_image_folder(
    out: Path, camera: Camera, targets: Targets, *, title: str, bits: int, faults: str = ""
) -> None:
    """Write camera.toml, targets.csv and a README.txt that explains the files that are there; to be called last.

    Args:
        title: first line of the README.  faults: its last lines, what is wrong on purpose.
    """
    write_text(out / "camera.toml", camera_toml(camera, targets))
    write_text(out / "targets.csv", targets_csv(targets))
    lines = [title, ""]
    for needed, names, meaning in CONTENTS:
        if all((out / name).exists() for name in needed):
            first, *more = meaning.format(bits=bits).split("\n")
            lines += [names.ljust(WIDTH) + first, *(" " * WIDTH + line for line in more)]
    write_text(out / "README.txt", "\n".join(lines) + "\n" + AXES + faults)
