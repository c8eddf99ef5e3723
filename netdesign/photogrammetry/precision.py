"""The precision of a tag corner in an image, before the image exists.

Closed form, fitted to Cramér-Rao bounds of the imaging model (tag sides 12-180 px, incidence 0-75°, blur 0.4-1.5 px;
residual 8 % rms):

    sigma² = (k · (sigma_n / dI) · s^0.521 · L^-0.538 · cos(i)^-0.436 · exp(0.787 (s/cell)²))² + floor²

    s = sqrt(blur² + 1/12)      blur of the optics and of the pixel, px
    L                           edge of the tag seen face-on, px;  i incidence;  cell = L cos(i) / 8, px
    sigma_n                     grey-level noise at mid level: shot, read and 8-bit quantisation noise
    dI                          grey-level step from black to white

It holds for cells of at least 1.2 px.
"""

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import Targets
from netdesign.photogrammetry.collinearity import in_camera

GREY_STEP = 215.0  # black to white of a printed tag in an 8-bit image
CELLS = 8.0  # data cells and black border along an edge of tag36h11


def grey_noise(camera: Camera) -> float:
    """Return the standard deviation of a grey level half way between black and white, in grey levels of 8 bit."""
    per_electron = 255.0 / camera.full_well_e
    return float(np.sqrt(per_electron * 127.5 + (per_electron * camera.read_noise_e) ** 2 + 1.0 / 12.0))


def corner_sigma(camera: Camera, edge_px: Floats | float, incidence: Floats | float) -> Floats:
    """Return the sigma per coordinate (…,) px of a corner of a tag.

    Args:
        camera: with ``corner_noise``; without, the constant ``sigma_px`` comes back.
        edge_px: (…,) edge of the tag seen face-on, px.  incidence: (…,) rad.
    """
    edge, incidence = np.broadcast_arrays(np.asarray(edge_px, dtype=np.float64), np.asarray(incidence))
    if camera.corner_noise is None:
        return np.full(edge.shape, camera.sigma_px)
    blur = np.sqrt(camera.blur_px**2 + 1.0 / 12.0)
    # Beyond 89.9° and below a hundredth of a pixel nothing is measured: keep the numbers finite there.
    cosine = np.maximum(np.cos(incidence), 1e-3)
    edge = np.maximum(edge, 1e-2)
    cell = edge * cosine / CELLS
    noise = (
        camera.corner_noise.k
        * (grey_noise(camera) / GREY_STEP)
        * blur**0.521
        * edge**-0.538
        * cosine**-0.436
        * np.exp(np.minimum(0.787 * (blur / cell) ** 2, 100.0))
    )
    return np.asarray(np.sqrt(noise**2 + camera.corner_noise.floor_px**2))


def sighting_sigma(camera: Camera, world_from_cam: Floats, targets: Targets) -> Floats:
    """Return the sigma per coordinate (n, m) px of every object point in every image, seen or not.

    Args:
        world_from_cam: (n, 4, 4) m.
    """
    if camera.corner_noise is None:
        return np.full((len(world_from_cam), 4 * len(targets.ids)), camera.sigma_px)
    points, normals = targets.points, targets.point_normals
    depth = in_camera(world_from_cam[:, None], points[None])[..., 2]
    ray = world_from_cam[:, None, :3, 3] - points[None]
    cosine = np.einsum("nmi,mi->nm", ray, normals) / np.linalg.norm(ray, axis=-1)
    focal = float(np.sqrt(camera.focal_px.prod()))
    edge = focal * targets.size_m / np.maximum(depth, 1e-9)
    return corner_sigma(camera, edge, np.arccos(np.clip(cosine, -1.0, 1.0)))
