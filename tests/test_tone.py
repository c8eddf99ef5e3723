"""The tone curve from the tags themselves, and pictures that cannot be what the camera took."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from netdesign.errors import InputError
from netdesign.imaging.measure import Gates, measure
from netdesign.imaging.optics import expose, noise_generator
from netdesign.imaging.pictures import linear, png_bytes, read_picture
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.imaging.tone import estimate_tone
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.photogrammetry.collinearity import project
from tests.scenes import CAMERA, plate_scene

CAM = replace(
    CAMERA, width_px=800, height_px=640, focal_px=np.array([1500.0, 1500.0]),
    principal_point_px=np.array([399.5, 319.5]),
)  # fmt: skip
SCENE = plate_scene(side=3, spacing=0.045, tag_size=0.02)
POSE = look_at(0.42 * sphere_directions(np.radians([20.0, 62.0])), np.zeros(3), 0.4)


@pytest.fixture(scope="module")
def light():
    return ReferenceRenderer(SCENE, CAM).render(inverse(POSE))


def _srgb(level):
    return np.where(level <= 0.0031308, 12.92 * level, 1.055 * np.maximum(level, 1e-9) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(
    ("curve", "expected", "apart"),
    [
        (lambda x: x, 1.0, 1e-12),
        (lambda x: x ** (1 / 1.8), 1.8, 0.06),
        (lambda x: x ** (1 / 2.2), 2.2, 0.06),
        (_srgb, 2.25, 0.15),
        (lambda x: (0.3 * x) ** (1 / 2.2), 2.2, 0.15),
    ],
)
def test_the_exponent_is_found_and_corners_are_where_they_belong(light, curve, expected, apart):
    grey = expose(light, CAM, noise_generator(3, 0), 16) / 65535
    picture = np.rint(255 * curve(grey)).astype(np.uint8)
    tone = estimate_tone([picture], CAM, "tag36h11")
    assert tone.tags >= 6
    assert tone.gamma == pytest.approx(expected, abs=apart)
    straight = picture if tone.gamma == 1.0 else linear(picture, tone.gamma)
    truth = project(POSE, SCENE.targets.points, CAM.intrinsics)[0].reshape(-1, 4, 2)
    row = {tag: index for index, tag in enumerate(SCENE.targets.ids.tolist())}
    good = [tag for tag in measure(straight, CAM, "tag36h11", 0.02, gates=Gates(own_noise=True)) if not tag.rejected]
    assert len(good) >= 6
    error = np.array([tag.corners_px - truth[row[tag.tag_id]] for tag in good])
    away = truth[[row[tag.tag_id] for tag in good]]
    away = away - away.mean(axis=1, keepdims=True)
    outward = (error * away).sum(axis=2) / np.linalg.norm(away, axis=2)
    assert abs(outward.mean()) < 0.008  # 0.11 px when the curve is left in


def test_twelve_bits_in_sixteen_are_found(light):
    picture = np.rint(4095 / 65535 * expose(light, CAM, noise_generator(3, 0), 16).astype(float)).astype(np.uint16)
    tags = measure(picture, CAM, "tag36h11", 0.02, gates=Gates(own_noise=True, min_contrast=0.01))
    assert sum(not tag.rejected for tag in tags) >= 6


def test_pictures_that_are_cut_short_or_of_another_size_are_refused(tmp_path, light):
    whole = png_bytes(expose(light, CAM, None, 8))
    path = tmp_path / "0000.png"
    path.write_bytes(whole)
    assert read_picture(path, CAM).shape == (640, 800)
    with pytest.raises(InputError, match="expected 801 x 640 px as the camera has, found 800 x 640"):
        read_picture(path, replace(CAM, width_px=801))
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut short"):
        read_picture(path, CAM)
    half = tmp_path / "0001.jpg"
    content = cv2.imencode(".jpg", np.asarray(expose(light, CAM, None, 8)))[1].tobytes()
    preview = b"\xff\xe1\x00\x08\xff\xd8\xff\xd9ab"  # a segment that holds a small whole picture
    for more in (content, content + bytes(5000), content[:2] + preview + content[2:]):
        half.write_bytes(more)  # what telephones write
        assert read_picture(half, CAM).shape == (640, 800)
    content = content[:2] + preview + content[2:]
    half.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="cut short"):
        read_picture(half, CAM)
