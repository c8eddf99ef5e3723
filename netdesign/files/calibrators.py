"""What calibration programs read: Kalibr's camchain and aprilgrid, OpenCV's camera file, our list of tags.

Formats: Kalibr's wiki, "YAML formats" (camera_model pinhole, distortion_model radtan = k1, k2, p1, p2, pixel centres
on whole numbers; an aprilgrid's tagSpacing is the gap between tags divided by tagSize); OpenCV's FileStorage.
"""

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import Targets

MM = 1e-3
FLAT_M = 1e-6


def _numbers(values: Floats) -> str:
    return ", ".join(repr(float(value)) for value in values)


def kalibr_camchain(camera: Camera) -> str:
    """Return Kalibr's camchain.yaml of one camera."""
    return (
        "cam0:\n"
        "  camera_model: pinhole\n"
        f"  intrinsics: [{_numbers(camera.intrinsics[:4])}]\n"
        "  distortion_model: radtan\n"
        f"  distortion_coeffs: [{_numbers(camera.distortion)}]\n"
        f"  resolution: [{camera.width_px}, {camera.height_px}]\n"
        "  rostopic: /cam0/image_raw\n"
    )


def kalibr_grid(targets: Targets) -> str | None:
    """Return Kalibr's aprilgrid.yaml, or None when the tags are not one flat, evenly spaced, parallel grid of tag36h11.

    Kalibr counts tags row by row from the lower left; sets with other numbers give its grid all the same, for its size.
    """
    if targets.family != "tag36h11":  # the only one that Kalibr looks for
        return None
    across, normal = targets.x_axes[0], targets.normals[0]
    upward = np.cross(normal, across)
    offset = targets.centres - targets.centres[0]
    parallel = np.abs(targets.normals - normal).max() < 1e-6 and np.abs(targets.x_axes - across).max() < 1e-6
    if not parallel or np.abs(offset @ normal).max() > FLAT_M:
        return None
    columns, rows = (np.unique(np.round(offset @ axis / FLAT_M)) * FLAT_M for axis in (across, upward))
    steps = np.concatenate([np.diff(columns), np.diff(rows)])
    if len(columns) * len(rows) != len(targets.ids) or not len(steps) or np.ptp(steps) > 2 * FLAT_M:
        return None
    spacing = (float(steps.mean()) - targets.size_m) / targets.size_m
    return (
        "# The tags have a black border of one cell; Kalibr's detector expects two unless blackTagBorder is set to 1.\n"
        "target_type: 'aprilgrid'\n"
        f"tagCols: {len(columns)}\n"
        f"tagRows: {len(rows)}\n"
        f"tagSize: {targets.size_m!r}\n"
        f"tagSpacing: {spacing:.9g}\n"
    )


def opencv_camera(camera: Camera) -> str:
    """Return a camera file for OpenCV's FileStorage: camera_matrix, distortion_coefficients, image size."""
    fx, fy, cx, cy = (float(value) for value in camera.intrinsics[:4])
    return (
        "%YAML:1.0\n---\n"
        f"image_width: {camera.width_px}\nimage_height: {camera.height_px}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {fx!r}, 0., {cx!r}, 0., {fy!r}, {cy!r}, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
        f"   data: [ {_numbers(camera.distortion)} ]\n"
    )


def targets_csv(targets: Targets) -> str:
    """Return the tags in the world frame, in the columns that [targets] file reads."""
    lines = ["tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz"]
    for index, tag in enumerate(targets.ids.tolist()):
        values = np.concatenate([targets.centres[index] / MM, targets.normals[index], targets.x_axes[index]])
        lines.append(f"{tag}," + ",".join(f"{value:.9g}" for value in values))
    return "\n".join(lines) + "\n"


def camera_toml(camera: Camera, targets: Targets) -> str:
    """Return the camera.toml of an image set: what ``adjust`` needs to measure its photographs."""
    return (
        "[camera]\n"
        f"width_px = {camera.width_px}\nheight_px = {camera.height_px}\n"
        f"focal_px = [{_numbers(camera.focal_px)}]\n"
        f"principal_point_px = [{_numbers(camera.principal_point_px)}]\n"
        f"distortion = [{_numbers(camera.distortion)}]\n"
        f"blur_px = {camera.blur_px!r}\nfull_well_e = {camera.full_well_e!r}\nread_noise_e = {camera.read_noise_e!r}\n"
        f'\n[targets]\nfamily = "{targets.family}"\nsize_mm = {targets.size_m / MM!r}\n'
        "\n[photographs]\ngamma = 1.0\n"
    )
