from dataclasses import replace

import numpy as np
import pytest

from netdesign.model.camera import CornerNoise
from netdesign.photogrammetry.precision import corner_rms, corner_sigma, sighting_sigma
from tests.scenes import CAMERA, plate_scene, ring

NOISY = replace(CAMERA, corner_noise=CornerNoise(k=3.10, floor_px=0.0))


@pytest.mark.parametrize(
    ("side", "degrees", "published"),
    [(12, 0, 0.0212), (24, 40, 0.0128), (54, 0, 0.0072), (54, 65, 0.0105), (120, 55, 0.0060), (180, 20, 0.0039)],
)
def test_closed_form_reproduces_the_bounds_it_was_fitted_to(side, degrees, published):
    # Cramér-Rao bounds measured for blur 0.7 px, full well 1500 e, read noise 8 e; the fit's residual is 8 % rms.
    assert corner_rms(NOISY, side, np.radians(degrees)) == pytest.approx(published, rel=0.25)


def test_laws():
    edges = np.array([15.0, 30, 60, 120])
    sigma = corner_rms(NOISY, edges, 0.0)
    assert (np.diff(sigma) < 0).all()
    assert (np.diff(corner_sigma(NOISY, 60.0, np.radians([0, 30, 60, 75]))) > 0).all()
    floor = replace(CAMERA, corner_noise=CornerNoise(k=3.10, floor_px=0.01))
    steep = corner_sigma(NOISY, 60.0, np.radians(np.linspace(0, 89, 90)))
    assert (np.diff(steep) > 0).all()  # the bound on any network relies on it
    np.testing.assert_allclose(corner_rms(floor, edges, 0.0) ** 2, sigma**2 + 1e-4, rtol=1e-12)
    np.testing.assert_array_equal(corner_sigma(CAMERA, edges, 0.0), CAMERA.sigma_px)


def test_sighting_sigma_per_image_and_point():
    targets = plate_scene(side=2).targets
    poses = ring(3)
    sigma = sighting_sigma(NOISY, poses, targets)
    assert sigma.shape == (3, 16)
    distance = np.linalg.norm(poses[0, :3, 3] - targets.points[0])
    assert sigma[0, 0] == pytest.approx(corner_sigma(NOISY, 3600 * 0.02 / distance, np.radians(40)), rel=0.1)
    np.testing.assert_array_equal(sighting_sigma(CAMERA, poses, targets), 0.1)
