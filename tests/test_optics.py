from dataclasses import replace

import numpy as np
import pytest

from netdesign.imaging.optics import Shading, decimate, expose, noise_generator, pixel_kernel
from tests.scenes import CAMERA


@pytest.mark.parametrize("supersample", [1, 2, 4])
@pytest.mark.parametrize("blur", [0.0, 0.5, 0.7, 1.5])
def test_kernel_has_unit_sum_no_shift_and_the_variance_of_blur_and_pixel(blur, supersample):
    taps = pixel_kernel(blur, supersample).astype(float)
    where = (np.arange(len(taps)) - (len(taps) - 1) / 2) / supersample
    assert taps.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(taps, taps[::-1], atol=1e-8)
    # S taps of width 1/S: with the width of a supersample the box has exactly the variance 1/12 of a pixel.
    variance = (taps * where**2).sum() + 1 / (12 * supersample**2)
    sampled = blur**2 if blur * supersample >= 0.7 else variance - 1 / 12  # a Gaussian narrower than a sample is cut
    assert variance == pytest.approx(sampled + 1 / 12, rel=3e-3)


def test_decimation_keeps_constants_and_linear_slopes_in_place():
    supersample, size = 4, 40
    x = (np.arange(size * supersample) + 0.5) / supersample - 0.5  # pixel coordinates of the samples
    fine = np.tile((x / 100).astype(np.float32), (size * supersample, 1))
    out = decimate(fine, 0.7, supersample, 0, size)
    np.testing.assert_allclose(out[:, 6:-6], np.tile(np.arange(size) / 100, (size, 1))[:, 6:-6], atol=1e-6)
    np.testing.assert_allclose(decimate(np.full((80, 80), 255, np.uint8), 0.7, 4, 0, 20), 1.0, atol=1e-6)


def test_bands_make_the_same_picture_as_the_whole():
    fine = np.random.default_rng(1).integers(0, 255, (120, 80), dtype=np.uint8)
    whole = decimate(fine, 0.7, 2, 0, 60)
    np.testing.assert_array_equal(decimate(fine, 0.7, 2, 20, 15), whole[20:35])


def test_noise_has_the_sensor_s_variance_and_depends_on_seed_and_image_only():
    light = np.full((400, 400), 0.5, np.float32)
    picture = expose(light, CAMERA, noise_generator(3, 7), 16).astype(float) / 65535
    electrons = picture * CAMERA.full_well_e
    # 160 000 samples: the variance is known to sqrt(2/160000) = 0.35 %.
    assert electrons.var() == pytest.approx(750 + CAMERA.read_noise_e**2, rel=0.02)
    assert electrons.mean() == pytest.approx(750, abs=0.3)
    again = expose(light, CAMERA, noise_generator(3, 7), 16)
    np.testing.assert_array_equal(again.astype(float) / 65535, picture)
    assert (expose(light, CAMERA, noise_generator(3, 8), 16) != again).any()


def test_rounding_and_clipping():
    light = np.array([[0.0, 0.25, 1.0, 1.7]], np.float32)
    np.testing.assert_array_equal(expose(light, CAMERA, None), np.array([[0, 64, 255, 255]], np.uint8))
    assert expose(light, CAMERA, None, 16).dtype == np.uint16


def test_shading_is_one_at_the_principal_point_and_falls_off():
    camera = replace(CAMERA, width_px=801, height_px=601, principal_point_px=np.array([400.0, 300.0]))
    factor = Shading(vignetting=4.0).factor(camera)
    assert factor[300, 400] == 1.0
    corner = 1 / np.sqrt(1 + (400 / 3600) ** 2 + (300 / 3600) ** 2)
    assert factor[0, 0] == pytest.approx(corner**4, rel=1e-6)
    slope = Shading(gradient=(0.4, 0.0)).factor(camera)
    assert slope[300, -1] - slope[300, 0] == pytest.approx(0.4, rel=1e-6)
