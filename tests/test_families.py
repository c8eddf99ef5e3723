"""Families of AprilTags beside tag36h11: facts against OpenCV, and the whole chain on each of them."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from netdesign.calibrate import calibrate_noise, write_calibration
from netdesign.errors import InputError
from netdesign.files.calibrators import kalibr_grid
from netdesign.files.noise import read_corner_noise
from netdesign.imaging.measure import measure
from netdesign.imaging.photograph import Photographer, Shoot
from netdesign.imaging.tags import cells, dictionary, texture
from netdesign.model.frames import look_at, sphere_directions
from netdesign.model.scene import FAMILIES
from netdesign.model.study import TargetsTable
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.precision import corner_rms
from tests.scenes import CAMERA, plate_scene

CAM = replace(
    CAMERA, width_px=500, height_px=420, focal_px=np.array([1000.0, 1000.0]),
    principal_point_px=np.array([249.5, 209.5]), distortion=np.array([-0.08, 0.02, 0.0003, -0.0002]),
)  # fmt: skip
OTHERS = [family for family in FAMILIES if family != "tag36h11"]


@pytest.mark.parametrize("family", FAMILIES)
def test_what_is_known_of_a_family_is_what_opencv_draws(family):
    assert family in get_args(TargetsTable.model_fields["family"].annotation)
    known = dictionary(family)
    assert FAMILIES[family] == (known.markerSize + 2, len(known.bytesList))
    pattern = cells(family, FAMILIES[family].ids - 1)
    assert pattern.shape == (FAMILIES[family].cells,) * 2
    assert pattern[0].sum() == pattern[-1].sum() == pattern[:, 0].sum() == pattern[:, -1].sum() == 0
    with pytest.raises(InputError, match=str(FAMILIES[family].ids - 1)):
        cells(family, FAMILIES[family].ids)
    image = texture(family, 3, 1, 0.0, 1.0)
    assert image.shape[1] % 4 == 0  # OpenGL reads rows in multiples of four bytes
    texels = image.shape[0] // (len(pattern) + 4)
    inner = image[2 * texels : -2 * texels, 2 * texels : -2 * texels]
    np.testing.assert_array_equal(inner[::texels, ::texels] == 255, cells(family, 3))


@pytest.mark.parametrize("renderer", ["reference", "pyrender"])
@pytest.mark.parametrize("family", FAMILIES)
def test_tags_of_every_family_are_drawn_found_and_measured(family, renderer):
    scene = plate_scene(side=3, spacing=0.04, tag_size=0.02)
    scene = replace(scene, targets=replace(scene.targets, family=family))
    pose = look_at(0.45 * sphere_directions(np.radians([20.0, 60.0])), np.zeros(3), 0.4)
    picture = Photographer(scene, CAM, Shoot(seed=3, renderer=renderer)).take(0, pose)
    truth = project(pose, scene.targets.points, CAM.intrinsics)[0].reshape(-1, 4, 2)
    found = measure(picture, CAM, family, 0.02)
    good = [tag for tag in found if not tag.rejected]
    assert [tag.tag_id for tag in good] == list(range(9))  # and nothing else, of 16 bits neither
    errors = np.array([tag.corners_px for tag in good]) - truth
    nees = [
        error.ravel() @ np.linalg.solve(tag.covariance_px2, error.ravel())
        for error, tag in zip(errors, good, strict=True)
    ]
    # chi-square with 72 degrees of freedom over them: 0.61 to 1.53 with 99.8 %; systematic errors come on top.
    assert 0.5 < np.mean(nees) / 8 < 2.0
    assert np.sqrt((errors**2).mean()) < 0.015


@pytest.mark.parametrize("family", OTHERS)
def test_the_shipped_noise_of_a_family_is_what_is_measured(family, tmp_path):
    shoot = Shoot(seed=2, renderer="reference")
    found = calibrate_noise(CAMERA, shoot, family=family, sides_px=(40.0,), incidences_deg=(30.0,), replicates=4)
    shipped = read_corner_noise(None, family)
    assert found.noise.cells == shipped.cells == FAMILIES[family].cells
    # A cell of 12 tags x 8 x 3 degrees of freedom: sigma to some 6 %; the closed form scatters by 5 %.
    assert found.noise.k == pytest.approx(shipped.k, rel=0.2)
    write_calibration(tmp_path / "noise.json", found, CAMERA, shoot)
    assert read_corner_noise(tmp_path / "noise.json", family) == found.noise
    with pytest.raises(InputError, match=f"tag36h11.*{family}"):
        read_corner_noise(tmp_path / "noise.json", "tag36h11")


def test_fewer_cells_are_measured_worse_but_smaller():
    """The same edge holds fewer lines of black against white; but its cells are larger, and blur costs less."""
    large, small = (
        [
            float(corner_rms(replace(CAMERA, corner_noise=read_corner_noise(None, family)), edge, 0.0))
            for family in ("tag16h5", "tag25h9", "tag36h11")
        ]
        for edge in (150.0, 10.0)
    )
    assert large == sorted(large, reverse=True)
    assert small == sorted(small)


def test_only_its_own_family_is_a_grid_of_kalibr():
    targets = plate_scene(side=3).targets
    assert kalibr_grid(targets) is not None
    assert kalibr_grid(replace(targets, family="tag25h9")) is None
