"""The precision of a tag corner in an image, before the image exists.

Closed form, fitted to the Cramér-Rao bounds of the full-pattern fit (tag sides 15-180 px, incidence 0-65°, blur
0.4-1.5 px, full wells 600-10000 e; residual 4 % rms, 13 % at most):

    sigma² = (k · (sigma_n / dI) · s^0.537 · L^-0.506 · cos(i)^-0.400 · exp(1.03 (s/c)² + 0.68 (s/c')²))² + floor²

    s = sqrt(blur² + 1/12)      blur of the optics and of the pixel, px
    L                           edge of the tag seen face-on, px;  i incidence
    c = L / 8, c' = c cos(i)    a cell along and across the tilt axis, px
    sigma_n                     grey-level noise at level 90 of 255: shot, read and 8-bit quantisation noise
    dI                          grey-level step from black to white

An edge of length L under blur s can be placed with sigma ~ sqrt(s/L): the powers are close to a half. The exponential
is what neighbouring edges lose by running into each other. It holds for cells c' of at least 1.2 px.

That is the root mean square of the two coordinates (``corner_rms``). A corner's error is not round: the edges across
the tilt axis are shorter, so that its variances in two directions differ by q = 1.6 / cos(i). Observations add their
information, the inverse of the covariance; the round error of the same information, which networks are designed with
(``corner_sigma``), is smaller:

    sigma_eff² = (noise part)² · 4 q / (1 + q)² + floor²        (to 2 % of the covariances of fitted tags up to 70°)
"""

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import Targets

GREY_STEP = 215.0  # black to white of a printed tag in an 8-bit image
EDGE_LEVEL = 90.0  # the level whose noise stands for an edge: below the middle, where the dark side weighs more
ELONGATION = 1.6  # ratio of a corner's largest to its smallest variance, face-on


def grey_noise(camera: Camera) -> float:
    """Return the standard deviation of a grey level on an edge, in grey levels of 8 bit."""
    per_electron = 255.0 / camera.full_well_e
    return float(np.sqrt(per_electron * EDGE_LEVEL + (per_electron * camera.read_noise_e) ** 2 + 1.0 / 12.0))


def corner_sigma(camera: Camera, edge_px: Floats | float, incidence: Floats | float) -> Floats:
    """Return the sigma (…,) px of round corner errors with the information that the real ones have.

    Arguments as for ``corner_rms``.
    """
    if camera.corner_noise is None:
        return corner_rms(camera, edge_px, incidence)
    # Held beyond 78°: no tag can be measured there, and sigma must not fall with the incidence.
    ratio = ELONGATION / np.maximum(np.cos(incidence), 0.2)
    noise = _noise(camera, edge_px, incidence) * 2.0 * np.sqrt(ratio) / (1.0 + ratio)
    return np.asarray(np.sqrt(noise**2 + camera.corner_noise.floor_px**2))


def corner_rms(camera: Camera, edge_px: Floats | float, incidence: Floats | float) -> Floats:
    """Return the root mean square error per coordinate (…,) px of a corner of a tag.

    Args:
        camera: with ``corner_noise``; without, the constant ``sigma_px`` comes back.
        edge_px: (…,) edge of the tag seen face-on, px.  incidence: (…,) rad.
    """
    if camera.corner_noise is None:
        return np.full(np.broadcast_shapes(np.shape(edge_px), np.shape(incidence)), camera.sigma_px)
    return np.asarray(np.sqrt(_noise(camera, edge_px, incidence) ** 2 + camera.corner_noise.floor_px**2))


def _noise(camera: Camera, edge_px: Floats | float, incidence: Floats | float) -> Floats:
    """Return the part of ``corner_rms`` that the sensor's noise makes, (…,) px."""
    noise = camera.corner_noise
    if noise is None:
        raise ValueError("camera: expected one with a corner noise")
    blur = np.sqrt(camera.blur_px**2 + 1.0 / 12.0)
    # Beyond 89.9° and below a hundredth of a pixel nothing is measured: keep the numbers finite there.
    cosine = np.maximum(np.cos(incidence), 1e-3)
    edge = np.maximum(np.asarray(edge_px, dtype=np.float64), 1e-2)
    loss = (blur / edge * noise.cells) ** 2 * (1.03 + 0.68 / cosine**2)
    sharpness = blur**0.537 * edge**-0.506 * cosine**-0.400 * np.exp(np.minimum(loss, 100.0))
    return np.asarray(noise.k * (grey_noise(camera) / GREY_STEP) * sharpness)


def sighting_sigma(camera: Camera, world_from_cam: Floats, targets: Targets) -> Floats:
    """Return the sigma per coordinate (n, m) px of every object point in every image, seen or not.

    Args:
        world_from_cam: (n, 4, 4) m.
    """
    if camera.corner_noise is None:
        return np.full((len(world_from_cam), 4 * len(targets.ids)), camera.sigma_px)
    points, normals = targets.points, targets.point_normals
    # Coordinate by coordinate: the search calls this for every network.
    ray = world_from_cam[:, :3, 3, None] - points.T[None]
    axis = world_from_cam[:, :3, 2, None]
    depth = -(ray[:, 0] * axis[:, 0] + ray[:, 1] * axis[:, 1] + ray[:, 2] * axis[:, 2])
    distance = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2 + ray[:, 2] ** 2)
    nx, ny, nz = normals.T
    cosine = (ray[:, 0] * nx + ray[:, 1] * ny + ray[:, 2] * nz) / distance
    focal = float(np.sqrt(camera.focal_px.prod()))
    edge = focal * targets.size_m / np.maximum(depth, 1e-9)
    return corner_sigma(camera, edge, np.arccos(np.clip(cosine, -1.0, 1.0)))
