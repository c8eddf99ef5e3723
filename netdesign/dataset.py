"""The verb ``dataset``: a free-standing synthetic image set from a recipe."""

import io
from pathlib import Path

import numpy as np

from netdesign.files.calibrators import camera_toml, kalibr_camchain, kalibr_grid, opencv_camera, targets_csv
from netdesign.files.recipe import ImageSetPlan, load_recipe
from netdesign.files.store import write_bytes, write_text
from netdesign.imageset import image_name, render_images, worker_pool
from netdesign.imaging.photograph import RendererName
from netdesign.imaging.pictures import png_bytes
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.model.frames import inverse
from netdesign.model.progress import Progress, silent


def render_dataset(
    recipe: Path, out: Path, *, workers: int = 0, renderer: RendererName = "pyrender", progress: Progress = silent
) -> int:
    """Write the free-standing image set of a recipe and return the number of images.

    Raises:
        InputError: the recipe or what it points to is wrong.
        EnvironmentProblem: the renderer's system libraries are missing.
    """
    plan = load_recipe(recipe, renderer)
    with worker_pool(workers) as executor:
        paths = render_images(
            plan.scene, plan.camera, plan.limits, plan.world_from_cam, out, plan.shoot,
            executor=executor, progress=progress, drawn=plan.drawn,
        )  # fmt: skip
    _write_extras(plan, out)
    return len(paths)


def _write_extras(plan: ImageSetPlan, out: Path) -> None:
    """Write what the recipe asks for beside the images, and a README that says what everything is."""
    extras, targets = plan.recipe.extras, plan.scene.targets
    write_text(out / "README.txt", _about(plan))
    write_text(out / "targets.csv", targets_csv(targets))
    write_text(out / "camera.toml", camera_toml(plan.camera, targets))
    if extras.kalibr:
        write_text(out / "camchain.yaml", kalibr_camchain(plan.camera))
        grid = kalibr_grid(targets)
        if grid is not None:
            write_text(out / "aprilgrid.yaml", grid)
    if plan.recipe.faults.wrong_ids:
        write_text(out / "faults.csv", _wrong_ids(plan))
    if extras.opencv:
        write_text(out / "camera-opencv.yaml", opencv_camera(plan.camera))
    if extras.depth or extras.tag_mask:
        for index, (scene, world_from_cam) in enumerate(zip(plan.drawn, plan.world_from_cam, strict=True)):
            depth, tags = ReferenceRenderer(scene, plan.camera).depth_and_tags(inverse(world_from_cam))
            if extras.depth:
                buffer = io.BytesIO()
                np.save(buffer, depth)
                write_bytes(out / "depth" / f"{index:04d}.npy", buffer.getvalue())
            if extras.tag_mask:
                write_bytes(out / "masks" / image_name(index), png_bytes(tags))


def _wrong_ids(plan: ImageSetPlan) -> str:
    """Return which tags show another id, per image."""
    true = plan.scene.targets.ids
    lines = ["image,tag,shown_id"]
    for index, scene in enumerate(plan.drawn):
        shown = scene.targets.ids[: len(true)]
        lines += [f"{image_name(index)},{true[row]},{shown[row]}" for row in np.flatnonzero(shown != true)]
    return "\n".join(lines) + "\n"


def _about(plan: ImageSetPlan) -> str:
    """Return the README of an image set."""
    recipe = plan.recipe
    return f"""{recipe.name}: {len(plan.world_from_cam)} synthetic images made by netdesign. {recipe.about}

images/*.png                        grey, {recipe.exposure.bits} bit, linear in light
truth.json                          exact poses, points (mm) and corner coordinates per image
corners.csv                         the same corner coordinates as a table
cameras.txt images.txt points3D.txt the truth as a COLMAP text model (pixel origin 0.5, lengths in mm)
camera.toml targets.csv             the camera and the tags (centre, normal, x axis in mm): `netdesign adjust` on this
                                    folder measures the photographs and starts from these
camchain.yaml aprilgrid.yaml        for Kalibr, camera-opencv.yaml for OpenCV (when asked for)
depth/*.npy masks/*.png             depth (float32, m) and tag id + 1 (16 bit) per pixel (when asked for)

Pixel origin: the centre of the top-left pixel is (0, 0), except in the COLMAP model. Camera axes: x right, y down,
z forward. Corners 0 to 3: top-left, top-right, bottom-right, bottom-left of the black square as OpenCV draws the tag.
Faults made on purpose, unknown to the truth: {recipe.faults.wrong_ids} pairs of exchanged ids in some images
(faults.csv), {recipe.faults.glare} spots of glare per image, {recipe.faults.clutter} boxes with foreign tags.
"""
