"""The photometric fit: derivatives by differences, truth recovered, covariance by sampling."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from netdesign.imaging.fit import SQUARE, fit_tag, homography
from netdesign.imaging.lens import ideal_pixels, measured_pixels
from netdesign.imaging.optics import Shading, expose, noise_generator
from netdesign.imaging.pattern import blur, cover, kernel_reach, kernels
from netdesign.imaging.reference import ReferenceRenderer
from netdesign.imaging.tags import cells
from netdesign.model.camera import CornerNoise
from netdesign.model.frames import inverse, look_at, sphere_directions
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.precision import corner_rms, corner_sigma
from tests.scenes import CAMERA, plate_scene

CAM = replace(
    CAMERA, width_px=420, height_px=420, focal_px=np.array([1500.0, 1500.0]),
    principal_point_px=np.array([209.5, 209.5]), distortion=np.array([-0.15, 0.05, 0.001, -0.002]),
)  # fmt: skip
SCENE = plate_scene(side=2, spacing=0.04, tag_size=0.02)
POSE = look_at(0.4 * sphere_directions(np.radians([20.0, 60.0])), np.zeros(3), 0.4)
TRUTH = project(POSE, SCENE.targets.points, CAM.intrinsics)[0].reshape(-1, 4, 2)
GAIN, FLOOR = 255 / 1500, (255 * 8 / 1500) ** 2 + 1 / 12


@pytest.fixture(scope="module")
def light():
    return ReferenceRenderer(SCENE, CAM).render(inverse(POSE))


def test_homography_maps_the_square_and_its_derivative_is_right():
    corners = np.array([[10.0, 12], [90, 20], [80, 95], [5, 85]])
    matrix, change = homography(corners, 8)
    mapped = np.column_stack([8 * SQUARE, np.ones(4)]) @ matrix.T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], corners, atol=1e-9)
    for index in range(8):
        step = np.zeros(8)
        step[index] = 1e-5
        ahead, behind = (homography(corners + sign * step.reshape(4, 2), 8)[0].ravel()[:8] for sign in (1, -1))
        np.testing.assert_allclose((ahead - behind) / 2e-5, change[:, index], rtol=1e-5, atol=1e-9)


def _edge(x, at, sigma):
    """A step at ``at`` blurred by a Gaussian and integrated over the pixels x, in closed form."""

    def upto(t):
        return t * norm.cdf(t) + norm.pdf(t)

    return sigma * (upto((x + 0.5 - at) / sigma) - upto((x - 0.5 - at) / sigma))


@pytest.mark.parametrize(("cell", "sigma", "limit"), [(4.0, 0.7, 5e-4), (8.0, 0.4, 2e-3), (16.0, 0.7, 1e-3)])
def test_a_tag_square_to_the_pixel_grid_is_measured_wherever_it_lies_in_the_pixel(cell, sigma, limit):
    pattern = np.pad(cells("tag36h11", 7), 1, constant_values=1).astype(float)
    pixels, camera = np.arange(int(12 * cell) + 12), np.array([1000.0, 1000, 0, 0, 0, 0, 0, 0])
    for shift in ((0.0, 0.0), (0.25, 0.25), (0.13, 0.4), (0.5, 0.25)):
        start = 2 * cell + 4 + np.array(shift)
        shares = [
            -np.diff([_edge(pixels, first + (k - 1) * cell, sigma) for k in range(11)], axis=0) for first in start
        ]
        white = np.einsum("ky,kl,lx->yx", shares[1], pattern, shares[0])
        inside = np.einsum("ky,lx->yx", shares[1], shares[0])
        corners = start + 8 * cell * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        picture = 257 * (20 + 215 * white + 160 * (1 - inside))
        fit = fit_tag(picture, cells("tag36h11", 7), corners + 0.1, camera, 65535 / 1500, 1e6)
        assert fit.converged
        assert np.abs(fit.corners_px - corners).max() < limit  # without further smoothing: 0.0025, 0.017, 0.021


def test_lens_inverse_and_derivative():
    ideal = np.random.default_rng(1).uniform(0, 420, (60, 2))
    measured, derivative = measured_pixels(ideal, CAM.intrinsics)
    np.testing.assert_allclose(ideal_pixels(measured, CAM.intrinsics), ideal, atol=1e-8)
    step = np.array([1e-4, 0.0])
    slope = (measured_pixels(ideal + step, CAM.intrinsics)[0] - measured_pixels(ideal - step, CAM.intrinsics)[0]) / 2e-4
    np.testing.assert_allclose(slope, derivative[:, :, 0], atol=1e-6)


def test_coverage_of_sub_pixels_adds_up_to_the_cells_area():
    pattern = cells("tag36h11", 5)
    corners = np.array([[20.3, 14.1], [75.2, 22.7], [66.8, 80.9], [12.4, 70.3]])
    tag_from_px = np.linalg.inv(homography(corners, 8)[0])
    x, y = np.meshgrid((np.arange(200) + 0.5) / 2 - 0.5, (np.arange(200) + 0.5) / 2 - 0.5)
    layers = np.empty((2, 200, 200))
    cover(x, y, tag_from_px, pattern, 0.5, layers)
    assert layers.min() > -1e-3  # the term for the shear is of first order
    assert (layers.sum(axis=0) < 1 + 1e-3).all()
    dark = ((1 - layers.sum(axis=0)) / 4).sum()
    to_px = homography(corners, 8)[0]
    expected = sum(_area(to_px, column, row) for row in range(8) for column in range(8) if pattern[row, column] == 0)
    assert dark == pytest.approx(expected, rel=2e-3)


def _area(to_px, column, row):
    square = (
        np.array([[column, row, 1], [column + 1, row, 1], [column + 1, row + 1, 1], [column, row + 1, 1]]) @ to_px.T
    )
    x, y = square[:, 0] / square[:, 2], square[:, 1] / square[:, 2]
    return 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))


@pytest.mark.parametrize("per_pixel", [1, 2])
def test_blur_derivatives_are_those_of_the_model_image(per_pixel):
    reach = kernel_reach(1.0, per_pixel)
    size = 24
    random = np.random.default_rng(3)
    white = random.uniform(0, 0.8, (size * per_pixel + 2 * reach,) * 2)
    layers = np.stack([white, 0.2 * (1 - white)])

    def image(sigma):
        out = np.empty((5, size, size))
        blur(layers, kernels(sigma, per_pixel, reach), per_pixel, 20.0, 230.0, 180.0, out)
        return 20 + 210 * out[0] + 160 * out[1], out

    grey, out = image(0.8)
    by_sigma = (image(0.8005)[0] - image(0.7995)[0]) / 1e-3
    np.testing.assert_allclose(out[4], by_sigma, atol=2e-3 * np.abs(by_sigma).max())
    # Slope: a linear layer has a constant one.
    ramp = np.tile(np.arange(size * per_pixel + 2 * reach) / per_pixel / 100, (size * per_pixel + 2 * reach, 1))
    layers = np.stack([ramp, np.zeros_like(ramp)])
    grey, out = image(0.8)
    np.testing.assert_allclose(out[2], 2.1, rtol=5e-3)
    np.testing.assert_allclose(out[3], 0.0, atol=1e-9)
    assert np.diff(grey, axis=1).mean() == pytest.approx(2.1, rel=1e-3)


def test_a_clean_picture_gives_the_truth(light):
    picture = expose(light, CAM, None, 16)
    for tag in range(4):
        fit = fit_tag(picture, cells("tag36h11", tag), TRUTH[tag] + 0.7, CAM.intrinsics, 257 * GAIN, 257**2 * FLOOR)
        assert fit.converged
        np.testing.assert_allclose(fit.corners_px, TRUTH[tag], atol=0.002)
        assert fit.sigma_px == pytest.approx(0.7, abs=0.005)
        assert fit.black / 65535 == pytest.approx(20 / 255, abs=1e-3)
        assert fit.white / 65535 == pytest.approx(235 / 255, abs=1e-3)


def test_covariance_is_the_scatter_of_repeated_pictures(light):
    errors, squares = [], []
    for image in range(25):
        picture = expose(light, CAM, noise_generator(11, image))
        for tag in range(4):
            fit = fit_tag(picture, cells("tag36h11", tag), TRUTH[tag] + 0.3, CAM.intrinsics, GAIN, FLOOR)
            error = (fit.corners_px - TRUTH[tag]).ravel()
            errors.append(error)
            squares.append(error @ np.linalg.solve(fit.covariance_px2, error))
    # 100 tags x 8: the mean of chi2(8)/8 is known to sqrt(2/800) = 5 %; 3.5 sigma.
    assert np.mean(squares) / 8 == pytest.approx(1.0, abs=0.175)
    errors = np.array(errors)
    assert np.abs(errors.reshape(-1, 2).mean(axis=0)).max() < 0.002
    noise = replace(CAM, corner_noise=CornerNoise(k=3.27, floor_px=0.0005))
    edge, incidence = 1500 * 0.02 / 0.4, np.radians(30)
    # 12.5 % is the closed form's worst case, 2 % the sample's.
    assert errors.std() == pytest.approx(corner_rms(noise, edge, incidence), rel=0.15)


@pytest.mark.parametrize("degrees", [0, 35, 50, 62])
def test_the_round_error_of_the_design_has_the_information_of_the_fitted_corners(degrees):
    camera = replace(CAM, distortion=np.zeros(4), corner_noise=CornerNoise(k=1.0, floor_px=0.0))
    side, ratios = 1500 * 0.02 / 0.4, []
    for azimuth in (10.0, 100.0, 250.0):
        pose = look_at(0.4 * sphere_directions(np.radians([azimuth, 90.0 - degrees])), np.zeros(3), 0.3)
        picture = ReferenceRenderer(SCENE, camera).render(inverse(pose))
        truth = project(pose, SCENE.targets.points, camera.intrinsics)[0].reshape(-1, 4, 2)
        for tag in range(4):
            fit = fit_tag(255 * picture, cells("tag36h11", tag), truth[tag], camera.intrinsics, GAIN, FLOOR)
            for corner in range(4):
                block = fit.covariance_px2[2 * corner : 2 * corner + 2, 2 * corner : 2 * corner + 2]
                ratios.append(np.sqrt(4.0 / (np.trace(np.linalg.inv(block)) * np.trace(block))))
    incidence = np.radians(degrees)
    expected = corner_sigma(camera, side, incidence) / corner_rms(camera, side, incidence)
    assert np.mean(ratios) == pytest.approx(expected, rel=0.04)


def test_uneven_light_is_part_of_the_model(light):
    factor = Shading(gradient=(0.8, -0.4)).factor(CAM)
    picture = expose(0.7 * light * factor, CAM, None, 16)
    fit = fit_tag(picture, cells("tag36h11", 0), TRUTH[0] + 0.4, CAM.intrinsics, 257 * GAIN, 257**2 * FLOOR)
    np.testing.assert_allclose(fit.corners_px, TRUTH[0], atol=0.005)
    assert np.abs(fit.light_slope).max() > 0.01


def test_a_wrong_pattern_or_no_tag_is_noticed(light):
    picture = expose(light, CAM, noise_generator(1, 0))
    wrong = fit_tag(picture, cells("tag36h11", 77), TRUTH[0], CAM.intrinsics, GAIN, FLOOR)
    assert not wrong.converged or wrong.chi2_per_dof > 10
    nothing = fit_tag(np.full((420, 420), 128, np.uint8), cells("tag36h11", 0), TRUTH[0], CAM.intrinsics, GAIN, FLOOR)
    assert not nothing.converged or nothing.white - nothing.black < 10
