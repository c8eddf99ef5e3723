"""COLMAP text models: what is written is read back, in COLMAP's conventions."""

import numpy as np
import pycolmap
import pytest

from netdesign.errors import InputError
from netdesign.files.colmap import ColmapModel, point3d_id, read_model, write_model
from netdesign.model.camera import Camera
from tests.scenes import ring

CAMERA = Camera(
    width_px=2448, height_px=2048, focal_px=[3600, 3610], principal_point_px=[1223.5, 1020.25],
    distortion=[-0.1, 0.02, 1e-4, -2e-4],
)  # fmt: skip


def model():
    """Three images, five points, random image coordinates."""
    random = np.random.default_rng(3)
    image, point = np.divmod(np.arange(15), 5)
    return ColmapModel(
        cameras=(CAMERA,), camera_ids=(1,), camera_of_image=[0, 0, 0], names=("a.png", "b.png", "c.png"),
        world_from_cam=ring(3), point_ids=tuple(point3d_id(tag, 2) for tag in (0, 3, 5, 8, 100)),
        points=random.normal(size=(5, 3)) * 0.1, image=image, point=point, xy_px=random.uniform(0, 2000, (15, 2)),
    )  # fmt: skip


def test_round_trip(tmp_path):
    written = model()
    write_model(tmp_path, written)
    found = read_model(tmp_path)
    assert found.names == written.names
    assert found.point_ids == written.point_ids
    np.testing.assert_allclose(found.world_from_cam, written.world_from_cam, atol=1e-14)
    np.testing.assert_allclose(found.points, written.points, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.image, written.image)
    np.testing.assert_array_equal(found.point, written.point)
    np.testing.assert_allclose(found.xy_px, written.xy_px, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.cameras[0].intrinsics, CAMERA.intrinsics, rtol=1e-15)


def test_pycolmap_sees_its_own_convention(tmp_path):
    write_model(tmp_path, model())
    reconstruction = pycolmap.Reconstruction(str(tmp_path))
    camera = reconstruction.cameras[1]
    assert camera.params[2] == pytest.approx(1224.0)
    np.testing.assert_allclose(reconstruction.images[1].points2D[0].xy, model().xy_px[0] + 0.5)
    centre = reconstruction.images[2].projection_center()
    np.testing.assert_allclose(centre, ring(3)[1, :3, 3] * 1000, atol=1e-9)


def test_same_model_same_bytes(tmp_path):
    for name in ("first", "second"):
        write_model(tmp_path / name, model())
    for path in (tmp_path / "first").iterdir():
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("cameras.txt", "OPENCV", "FISHEYE", "camera model"),
        ("cameras.txt", "1 OPENCV 2448", "1 OPENCV x", "numbers"),
        ("cameras.txt", " 3610 ", " -1 ", "positive size and focal length"),
        ("images.txt", "a.png", "", r"images\.txt:5: expected IMAGE_ID, .* found 9 words"),
        ("images.txt", " 1 a.png", " 8 a.png", r"images\.txt:5: camera 8 of image a\.png is not in cameras\.txt"),
        ("points3D.txt", "\n3 ", "\nthree ", r"points3D\.txt:4: expected POINT3D_ID x y z"),
        ("points3D.txt", "\n3 ", "\n4 ", "point 3 of image a.png is not in points3D.txt"),
    ],
)
def test_malformed_models_are_one_line(tmp_path, file, old, new, says):
    write_model(tmp_path, model())
    path = tmp_path / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=says) as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"cameras\.txt"):
        read_model(tmp_path)


def test_our_reading_is_pycolmaps(tmp_path):
    write_model(tmp_path, model())
    reconstruction, found = pycolmap.Reconstruction(str(tmp_path)), read_model(tmp_path)
    for index, name in enumerate(found.names):
        image = next(image for image in reconstruction.images.values() if image.name == name)
        np.testing.assert_allclose(
            found.world_from_cam[index, :3, 3] * 1000, image.projection_center(), rtol=0, atol=1e-10
        )
        rows = found.image == index
        np.testing.assert_array_equal(found.xy_px[rows] + 0.5, [p.xy for p in image.points2D])
        ids = np.array(found.point_ids)[found.point[rows]]
        np.testing.assert_array_equal(ids, [p.point3D_id for p in image.points2D])


def test_what_other_programs_write(tmp_path):
    """Windows line ends, comments anywhere, blanks and folders in names, POINTS2D left out, big ids, unused cameras."""
    (tmp_path / "cameras.txt").write_bytes(
        b"# comment\r\n\r\n12 SIMPLE_RADIAL 640 480 500 320 240 0.01\r\n7 PINHOLE 640 480 500 510 320 240\r\n"
        b"3 RADIAL 640 480 600 320 240 0.1 0.02\r\n"
    )
    head = "0 0 0 1 2 3"
    (tmp_path / "images.txt").write_bytes(
        (
            f"# images\r\n30 1 {head} 12 dir one/bild 2.jpg\r\n10 20 1000001 11 21 -1 1 2 18446744073709551615\r\n"
            f"# another\r\n20 1 {head} 7 ü.jpg\r\n5 1 {head} 12 a.jpg\r\n\r\n6 2 {head} 12 1 2 3\r\n"
            "  7 8 5   9 9 1000001\r\n"
        ).encode()
    )
    (tmp_path / "points3D.txt").write_text("1000001 1 2 3\n5 4 5 6 255 255 255 0.5 1 0 2 0\n")
    found = read_model(tmp_path)
    assert found.names == ("1 2 3", "a.jpg", "dir one/bild 2.jpg", "ü.jpg")
    assert found.camera_ids == (7, 12)
    assert found.camera_of_image.tolist() == [1, 1, 1, 0]
    assert found.point_ids == (5, 1000001)
    assert list(zip(found.image.tolist(), found.point.tolist(), strict=True)) == [(0, 0), (0, 1), (2, 1)]
    np.testing.assert_allclose(found.xy_px, np.array([[7, 8], [9, 9], [10, 20]]) - 0.5)
    np.testing.assert_allclose(found.cameras[1].intrinsics, [500, 500, 319.5, 239.5, 0.01, 0, 0, 0])
