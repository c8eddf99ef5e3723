"""The verb ``dataset``: a free-standing synthetic image set from a recipe."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netdesign.errors import InputError
from netdesign.files.calibrators import kalibr_camchain, kalibr_grid, opencv_camera
from netdesign.files.image_folder import complete_image_folder
from netdesign.files.recipe import ImageSetPlan, load_recipe
from netdesign.files.store import write_bytes, write_text
from netdesign.imageset import render_images, worker_pool
from netdesign.imaging.photograph import RendererName
from netdesign.imaging.pictures import png_bytes
from netdesign.imaging.plausible import enclosed, fold_radius_px, image_radius_px
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.model.frames import inverse
from netdesign.model.progress import Progress, silent
from netdesign.photogrammetry.connectivity import listed
from netdesign.photogrammetry.visibility import sightings
from netdesign.truth import image_name

# What a recipe may ask for: an earlier recipe's would be taken for files of this one.
EXTRAS = ("depth/*.npy", "masks/*.png", "camchain.yaml", "aprilgrid.yaml", "camera-opencv.yaml", "faults.csv")


@dataclass(frozen=True, kw_only=True)
class DatasetOutcome:
    """How many images were written, and the names of those that show no tag by the study's visibility limits."""

    images: int
    blind: tuple[str, ...]

    @property
    def text(self) -> str:
        """What was written, and in a second line what is to be known about it."""
        written = f"{self.images} images, COLMAP model, truth.json"
        if not self.blind:
            return written
        return (
            f"{written}\nwarning      {len(self.blind)} of {self.images} image(s) show no tag within the study's "
            f"[visibility]: {listed(self.blind)}"
        )


def render_dataset(
    recipe: Path, out: Path, *, workers: int = 0, renderer: RendererName = "pyrender", progress: Progress = silent
) -> DatasetOutcome:
    """Write the free-standing image set of a recipe.

    Raises:
        InputError: the recipe or what it points to is wrong.
        EnvironmentProblem: the renderer's system libraries are missing.
    """
    plan = load_recipe(recipe, renderer)
    _check(plan, recipe)
    with worker_pool(workers) as executor:
        paths = render_images(
            plan.scene, plan.camera, plan.limits, plan.world_from_cam, out, plan.shoot,
            executor=executor, progress=progress, drawn=plan.drawn,
        )  # fmt: skip
    _write_extras(plan, out)
    visible = sightings(plan.scene, plan.camera, plan.world_from_cam, plan.limits).visible
    blind = tuple(image_name(index) for index in np.flatnonzero(~visible.any(axis=1)).tolist())
    return DatasetOutcome(images=len(paths), blind=blind)


def _check(plan: ImageSetPlan, path: Path) -> None:
    """Refuse what no camera can photograph.

    Raises:
        InputError: the image folds, or a camera stands inside the part.
    """
    fold, corner = fold_radius_px(plan.camera.intrinsics), image_radius_px(plan.camera)
    if fold < corner:
        raise InputError(
            f"{path}: camera.distortion: expected an image that does not fold up to its corners, {corner:.0f} px from "
            f"the principal point; found that no ray arrives farther than {fold:.0f} px out"
        )
    inside = enclosed(plan.scene.part, plan.world_from_cam[:, :3, 3])
    if inside.any():
        names = [image_name(index) for index in np.flatnonzero(inside).tolist()]
        raise InputError(f"{path}: poses: expected cameras outside the part, found inside it: {listed(names)}")


def _write_extras(plan: ImageSetPlan, out: Path) -> None:
    """Write what the recipe asks for beside the images, and a README that says what everything is."""
    extras, targets = plan.recipe.extras, plan.scene.targets
    for stale in (name for pattern in EXTRAS for name in out.glob(pattern)):
        stale.unlink()
    for folder in (out / "depth", out / "masks"):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
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
    title = f"{plan.recipe.name}: {len(plan.world_from_cam)} synthetic images made by netdesign. {plan.recipe.about}"
    bits = plan.recipe.exposure.bits
    complete_image_folder(out, plan.camera, targets, title=title.strip(), bits=bits, faults=_faults(plan))


def _wrong_ids(plan: ImageSetPlan) -> str:
    """Return which tags show another id, per image."""
    true = plan.scene.targets.ids
    lines = ["image,tag,shown_id"]
    for index, scene in enumerate(plan.drawn):
        shown = scene.targets.ids[: len(true)]
        lines += [f"{image_name(index)},{true[row]},{shown[row]}" for row in np.flatnonzero(shown != true)]
    return "\n".join(lines) + "\n"


def _faults(plan: ImageSetPlan) -> str:
    """Return what is wrong on purpose, for the README of the set; nothing if nothing is."""
    faults = plan.recipe.faults
    wrong = (
        (faults.wrong_ids, f"{faults.wrong_ids} pair(s) of exchanged ids in some images (faults.csv)"),
        (faults.glare, f"{faults.glare} spot(s) of glare per image"),
        (faults.clutter, f"{faults.clutter} box(es) with foreign tags"),
    )
    named = [text for count, text in wrong if count]
    return f"Faults made on purpose, unknown to the truth:\n{', '.join(named)}.\n" if named else ""
