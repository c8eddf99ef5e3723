"""What synthetic pictures are: truth.json, corners.csv and a COLMAP text model beside them.

truth.json holds every setting that changes a pixel, so that pictures of other settings are known and made again.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.files.colmap import ColmapModel, point3d_id, write_model
from netdesign.files.design_json import projection_record
from netdesign.files.store import write_json, write_text
from netdesign.imaging.photograph import Shoot
from netdesign.model.arrays import Bools, Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import CORNERS_PER_TAG, Scene

MM = 1e-3
UM = 1e-6


def image_name(index: int) -> str:
    """Return the file name of picture ``index``."""
    return f"{index:04d}.png"


def write_truth(
    scene: Scene, camera: Camera, world_from_cam: Floats, visible: Bools, xy_px: Floats, out: Path, shoot: Shoot,
    drawn: Sequence[Scene], study_sha256: str | None,
) -> None:  # fmt: skip
    """Write what the pictures are; pictures of another truth are removed first.

    Args:
        world_from_cam: (n, 4, 4) m.  visible: (n, m).  xy_px: (n, m, 2).
        drawn: what stands before the camera, per image.
    """
    names = [image_name(index) for index in range(len(world_from_cam))]
    ids = scene.targets.point_ids
    poses = world_from_cam.copy()
    poses[:, :3, 3] /= MM
    truth = {
        "camera": camera_record(camera),
        **_taken(shoot),
        "drawn_sha256": _fingerprint(drawn),
        "tags": {"family": scene.targets.family, "size_mm": scene.targets.size_m / MM},
        "points": [{"id": name, "xyz_mm": xyz / MM} for name, xyz in zip(ids, scene.targets.points, strict=True)],
        "images": [
            {
                "name": name,
                "world_from_cam_mm": poses[index],
                "points": [ids[j] for j in np.flatnonzero(visible[index])],
                "xy_px": xy_px[index, visible[index]],
            }
            for index, name in enumerate(names)
        ],
    }
    before = (out / "truth.json").read_bytes() if (out / "truth.json").is_file() else b""
    write_json(out / "truth.json", "truth", truth, study_sha256)
    if before != (out / "truth.json").read_bytes():
        for stale in (out / "images").glob("*.png"):
            stale.unlink()
    image, point = np.nonzero(visible)
    lines = [
        f"{names[i]},{ids[j].replace('.', ',')},{xy_px[i, j, 0]:.6f},{xy_px[i, j, 1]:.6f}"
        for i, j in zip(image, point, strict=True)
    ]
    write_text(out / "corners.csv", "\n".join(["image,tag,corner,x_px,y_px", *lines]) + "\n")
    write_model(
        out,
        ColmapModel(
            cameras=(camera,), camera_ids=(1,), camera_of_image=np.zeros(len(names), np.int64), names=tuple(names),
            world_from_cam=world_from_cam,
            point_ids=tuple(point3d_id(int(tag), k) for tag in scene.targets.ids for k in range(CORNERS_PER_TAG)),
            points=scene.targets.points, image=image, point=point, xy_px=xy_px[image, point],
        ),
    )  # fmt: skip


def _taken(shoot: Shoot) -> dict[str, Any]:
    """Return every setting of ``Shoot``, lengths in mm: one that is added there is compared without a word here."""
    settings = asdict(shoot)
    settings["motion_mm"] = [way / MM for way in settings.pop("motion_m")]
    return settings


def _fingerprint(drawn: Sequence[Scene]) -> str:
    """Return what tells apart the scenes that stood before the camera, faults included, picture by picture."""
    digests: dict[int, bytes] = {}
    whole = hashlib.sha256()
    for scene in drawn:
        if id(scene) not in digests:
            part, tags = scene.part, scene.targets
            arrays = (part.vertices, part.faces, tags.ids, tags.centres, tags.normals, tags.x_axes, tags.size_m)
            digests[id(scene)] = hashlib.sha256(b"".join(np.asarray(item).tobytes() for item in arrays)).digest()
        whole.update(digests[id(scene)])
    return whole.hexdigest()


def camera_record(camera: Camera) -> dict[str, Any]:
    """Return a camera with the keys of a study's [camera] table."""
    return {
        **projection_record(camera),
        "pixel_um": None if camera.pixel_m is None else camera.pixel_m / UM,
        "f_number": camera.f_number,
        "focus_mm": None if camera.focus_m is None else camera.focus_m / MM,
        "blur_px": camera.blur_px,
        "full_well_e": camera.full_well_e,
        "read_noise_e": camera.read_noise_e,
    }
