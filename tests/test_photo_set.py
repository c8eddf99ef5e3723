"""Photographs of a tagged part, adjusted: with nominal coordinates, and with nothing but the size of the tags."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from netdesign.adjust import adjust_folder
from netdesign.adjustment.initial import TagSighting, poses_and_tags, poses_on_known_tags
from netdesign.errors import InfeasibleError, InputError
from netdesign.imageset import render_images
from netdesign.imaging.detect import pose_from_tag
from netdesign.imaging.photograph import Shoot
from netdesign.model.frames import pose, similarity
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.visibility import sightings
from tests.scenes import CAMERA, LIMITS, box_scene, ring

CAMERA_TOML = """[camera]
width_px = 2448
height_px = 2048
focal_px = [3600, 3600]
principal_point_px = [1223.5, 1023.5]

[targets]
size_mm = 20
"""


def _tag_frames(targets):
    up = np.cross(targets.normals, targets.x_axes)
    return pose(np.stack([targets.x_axes, up, targets.normals], axis=2), targets.centres)


def _seen(scene, poses, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    targets = scene.targets
    visible = sightings(scene, CAMERA, poses, LIMITS).visible
    found = []
    for i, camera in enumerate(poses):
        for g in range(len(targets.ids)):
            if visible[i, 4 * g]:
                xy, _ = project(camera, targets.points[4 * g : 4 * g + 4], CAMERA.intrinsics)
                xy = xy + noise * rng.standard_normal(xy.shape)
                candidates = tuple(pose_from_tag(xy, targets.size_m, CAMERA.intrinsics))
                found.append(TagSighting(image=i, tag=g, corners_px=xy, candidates=candidates))
    return found


def test_start_values_from_tags_alone_are_within_reach_of_the_adjustment():
    scene = box_scene(spacing=0.06)
    poses = ring(8, elevation_deg=40.0)
    found = _seen(scene, poses)
    names = [str(i) for i in range(8)]
    tags = [str(tag) for tag in scene.targets.ids]
    known, placed = poses_on_known_tags(found, _tag_frames(scene.targets), 0.02, CAMERA.intrinsics, 8)
    assert placed.all()
    assert np.linalg.norm(known[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.05
    _, frames = poses_and_tags(found, 0.02, CAMERA.intrinsics, names, tags)
    scale, rotation, translation = similarity(frames[:, :3, 3], scene.targets.centres)
    moved = scale * frames[:, :3, 3] @ rotation.T + translation
    assert np.abs(moved - scene.targets.centres).max() < 0.03
    lonely = [s for s in found if s.image != 3]
    with pytest.raises(InfeasibleError, match="ties these to the others: image 3"):
        poses_and_tags(lonely, 0.02, CAMERA.intrinsics, names, tags)


@pytest.mark.slow
def test_rendered_photographs_known_and_unknown_part(tmp_path):
    scene = box_scene(spacing=0.07, tag_size=0.03)
    camera = replace(CAMERA, width_px=1224, height_px=1024, focal_px=[1800, 1800], principal_point_px=[611.5, 511.5])
    poses = np.concatenate([ring(5, elevation_deg=35.0), ring(3, elevation_deg=65.0, roll=np.pi / 2)])
    render_images(scene, camera, LIMITS, poses, tmp_path / "rendered", Shoot(seed=1, supersample=3))
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "rendered" / "images").rename(folder / "images")
    toml = CAMERA_TOML.replace("2448", "1224").replace("2048", "1024").replace("3600, 3600", "1800, 1800")
    (folder / "camera.toml").write_text(toml.replace("1223.5, 1023.5", "611.5, 511.5").replace("= 20", "= 30"))
    truth = dict(zip(scene.targets.point_ids, scene.targets.points, strict=True))

    def error_of(outcome):
        rows = [row for row in outcome.record["points"] if row["xyz_mm"][0] is not None]
        found = np.array([row["xyz_mm"] for row in rows]) * 1e-3
        true = np.array([truth[row["id"]] for row in rows])
        scale, rotation, translation = similarity(found, true)
        assert len(rows) >= 80
        return scale, float(np.sqrt(((scale * found @ rotation.T + translation - true) ** 2).mean()))

    scale, error = error_of(adjust_folder(folder, robust=True))
    assert scale == pytest.approx(1.0, abs=2e-3)  # from the mean edge of the tags
    assert error < 40e-6
    targets = scene.targets
    lines = ["tag,x_mm,y_mm,z_mm,nx,ny,nz,ux,uy,uz"]
    rng = np.random.default_rng(0)
    for tag, centre, normal, x_axis in zip(targets.ids, targets.centres, targets.normals, targets.x_axes, strict=True):
        values = [*(1e3 * centre + 0.5 * rng.standard_normal(3)), *normal, *x_axis]
        lines.append(",".join([str(tag), *(repr(float(value)) for value in values)]))
    (folder / "targets.csv").write_text("\n".join(lines) + "\n")
    known = adjust_folder(folder, robust=True)
    assert error_of(known)[1] < 40e-6
    assert 0.6 < known.adjustment.sigma0 < 1.6

    # As a user brings them: compressed, names of a camera, one picture of nothing, the focal length from a catalogue.
    phone = tmp_path / "phone"
    phone.mkdir()
    for number, path in enumerate(sorted((folder / "images").glob("*.png"))):
        Image.open(path).convert("RGB").save(phone / f"IMG {4711 + number}.JPG", quality=92)
    Image.new("RGB", (1224, 1024), (90, 100, 110)).save(phone / "IMG 4700.JPG")
    (phone / "camera.toml").write_text((folder / "camera.toml").read_text().replace("1800, 1800", "1850, 1850"))
    outcome = adjust_folder(phone, refine=("f", "cx", "cy"))
    scale, error = error_of(outcome)
    assert scale == pytest.approx(1.0, abs=2e-3)
    assert error < 40e-6
    assert 0.6 < outcome.adjustment.sigma0 < 1.6
    assert outcome.adjustment.intrinsics[0, 0] == pytest.approx(
        1800, abs=5 * np.sqrt(outcome.adjustment.parameter_covariance[0, 0])
    )
    assert any("show no usable tag and are left out: IMG 4700.JPG" in text for text in outcome.adjustment.warnings)


def test_bad_image_sets_are_one_line(tmp_path):
    folder = tmp_path / "set"
    (folder / "images").mkdir(parents=True)
    (folder / "camera.toml").write_text(CAMERA_TOML)
    with pytest.raises(InputError, match="expected a COLMAP text model"):
        adjust_folder(folder)
    from netdesign.imaging.pictures import png_bytes

    for name in ("a.png", "b.png"):
        (folder / "images" / name).write_bytes(png_bytes(np.full((2048, 2448), 128, np.uint8)))
    with pytest.raises(InfeasibleError, match="tags of tag36h11 in at least 2 photographs, found them in 0 of 2"):
        adjust_folder(folder)
    (folder / "camera.toml").write_text(CAMERA_TOML.replace("size_mm = 20", ""))
    with pytest.raises(InputError, match=r"targets\.size_mm"):
        adjust_folder(folder)
    (folder / "tags.csv").write_text("tag,size_mm\n1,20\n2,30\n")
    with pytest.raises(InputError, match="tags of one size"):
        adjust_folder(folder)
    (folder / "camera.toml").write_text(CAMERA_TOML.replace("focal_px", "focal_pixel"))
    with pytest.raises(InputError, match=r"camera\.toml: focal_pixel: unknown key.*focal_px"):
        adjust_folder(folder)
