"""The camera: interior orientation, optics, sensor and the noise of its image coordinates."""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats, frozen


@dataclass(frozen=True, kw_only=True)
class CornerNoise:
    """The calibrated noise of a tag corner: ``k`` and ``floor_px`` of the closed form in photogrammetry/precision.

    sigma² = (k · (sigma_n/dI) · s^0.537 · L^-0.506 · cos(i)^-0.400 · exp(1.03 (s/c)² + 0.68 (s/c')²))² + floor².

    k is that of a family of tags; ``cells`` along its edge L make the cells c and, across the tilt axis, c'.
    """

    k: float
    floor_px: float
    cells: int = 8


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A calibrated camera. Pixel origin: the centre of the top-left pixel is (0, 0).

    Attributes:
        focal_px: (fx, fy).
        principal_point_px: (cx, cy).
        distortion: OpenCV's k1, k2, p1, p2.
        pixel_m: pixel pitch; f_number and focus_m: with it they give the depth of field. None: unlimited.
        sigma_px: image-coordinate noise per coordinate, unless ``corner_noise`` gives one per sighting.
        blur_px: Gaussian sigma of the optics, before pixel integration.
        full_well_e, read_noise_e: sensor model; grey levels are 8 bit.
        dof_blur_px: largest diameter of the circle of confusion that counts as sharp.
    """

    width_px: int
    height_px: int
    focal_px: Floats
    principal_point_px: Floats
    distortion: Floats
    pixel_m: float | None = None
    f_number: float | None = None
    focus_m: float | None = None
    sigma_px: float = 0.1
    corner_noise: CornerNoise | None = None
    blur_px: float = 0.7
    full_well_e: float = 1500.0
    read_noise_e: float = 8.0
    dof_blur_px: float = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "focal_px", frozen("focal_px", self.focal_px, (2,)))
        object.__setattr__(self, "principal_point_px", frozen("principal_point_px", self.principal_point_px, (2,)))
        object.__setattr__(self, "distortion", frozen("distortion", self.distortion, (4,)))
        if not (np.isfinite(self.focal_px).all() and (self.focal_px > 0).all()):
            raise ValueError(f"focal_px: expected two positive numbers, found {self.focal_px.tolist()}")

    @property
    def intrinsics(self) -> Floats:
        """(8,): fx, fy, cx, cy, k1, k2, p1, p2."""
        return np.concatenate([self.focal_px, self.principal_point_px, self.distortion])

    def depth_of_field(self) -> tuple[float, float]:
        """Return the near and far limits of sharpness in m along the optical axis.

        Thin lens, circle of confusion of ``dof_blur_px`` pixels; (0, inf) when the camera defines no optics.
        """
        if self.pixel_m is None or self.f_number is None or self.focus_m is None:
            return 0.0, float("inf")
        # The principal distance f_px·pitch is the image distance; 1/f = 1/focus + 1/image distance.
        image_distance = float(self.focal_px[0]) * self.pixel_m
        focal_length = 1.0 / (1.0 / self.focus_m + 1.0 / image_distance)
        confusion = self.dof_blur_px * self.pixel_m
        reach = self.f_number * confusion * (self.focus_m - focal_length) / focal_length**2
        near = self.focus_m / (1.0 + reach)
        far = self.focus_m / (1.0 - reach) if reach < 1.0 else float("inf")
        return near, far
