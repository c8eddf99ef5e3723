"""From a supersampled picture to grey levels: blur and pixel integration, shading, noise, quantisation.

Everything is linear in light; full scale is 1. The fit (``fit.py``) models the same physics and shares no code with
this file, so that agreement between the two means something.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netdesign.model.camera import Camera
from netdesign.model.compiled import FAST, entry

Picture = NDArray[np.float32]


def pixel_kernel(blur_px: float, supersample: int, smoothed: float = 0.0) -> NDArray[np.float32]:
    """Return the taps (symmetric, sum 1) of Gaussian blur and pixel integration on the supersampled grid.

    The box of the pixel is ``supersample`` equal taps: together with the width of a supersample that is exactly one
    pixel. The Gaussian is sampled; convolving it with a continuous box instead would count the box twice.

    Args:
        smoothed: variance, in supersamples squared, by which the picture is blurred already beyond the width of a
            supersample; taken out of the Gaussian.
    """
    reach = int(np.ceil(4.5 * blur_px * supersample))
    offsets = np.arange(-reach, reach + 1) / supersample
    variance = blur_px**2 - smoothed / supersample**2
    gaussian = np.exp(-0.5 * offsets**2 / variance) if variance > 0 else (offsets == 0).astype(float)
    taps = np.convolve(gaussian / gaussian.sum(), np.full(supersample, 1 / supersample))
    return taps.astype(np.float32)


def margin_px(blur_px: float) -> int:
    """Return how many pixels beyond a row the kernel of ``pixel_kernel`` looks."""
    return int(np.ceil(4.5 * blur_px)) + 1


@entry(fastmath=FAST)
def _decimate(
    fine: NDArray[Any], taps: NDArray[np.float32], supersample: int, first_row: int, scale: float, out: Picture
) -> None:
    rows, columns = out.shape
    fine_rows, fine_columns = fine.shape
    reach = (len(taps) - supersample) // 2
    column_sum = np.empty(fine_columns, np.float32)
    for row in range(rows):
        column_sum[:] = 0.0
        start = (row + first_row) * supersample - reach
        for tap in range(len(taps)):
            source = min(max(start + tap, 0), fine_rows - 1)
            weight = taps[tap]
            for column in range(fine_columns):
                column_sum[column] += weight * fine[source, column]
        for column in range(columns):
            start_column = column * supersample - reach
            total = np.float32(0.0)
            if start_column >= 0 and start_column + len(taps) <= fine_columns:
                for tap in range(len(taps)):
                    total += taps[tap] * column_sum[start_column + tap]
            else:
                for tap in range(len(taps)):
                    total += taps[tap] * column_sum[min(max(start_column + tap, 0), fine_columns - 1)]
            out[row, column] = total * np.float32(scale)


def decimate(
    fine: NDArray[Any], blur_px: float, supersample: int, first_row: int, rows: int, smoothed: float = 0.0
) -> Picture:
    """Blur, integrate over pixels and decimate in one separable filter.

    Args:
        fine: (r·S, w·S) supersampled light: uint8 with full scale 255, or float32 with full scale 1.
        first_row, rows: the pixel rows wanted, counted from the first row of ``fine``; what the filter sees beyond
            the border is the border's own value.
        smoothed: as for ``pixel_kernel``.

    Returns:
        (rows, w) linear light, full scale 1.
    """
    out = np.empty((rows, fine.shape[1] // supersample), np.float32)
    scale = 1 / 255 if fine.dtype == np.uint8 else 1.0
    _decimate(fine, pixel_kernel(blur_px, supersample, smoothed), supersample, first_row, scale, out)
    return out


@dataclass(frozen=True, kw_only=True)
class Shading:
    """Uneven light on the sensor.

    Attributes:
        vignetting: exponent of the cosine law, 4 for a simple lens, 0 for none.
        gradient: relative change of the light from the left to the right and from the top to the bottom edge.
    """

    vignetting: float = 0.0
    gradient: tuple[float, float] = (0.0, 0.0)

    def factor(self, camera: Camera) -> Picture:
        """Return the (h, w) factor on the light of every pixel; 1 at the principal point without a gradient."""
        x = np.arange(camera.width_px, dtype=np.float64)[None, :]
        y = np.arange(camera.height_px, dtype=np.float64)[:, None]
        slope_x = (x - camera.principal_point_px[0]) / camera.focal_px[0]
        slope_y = (y - camera.principal_point_px[1]) / camera.focal_px[1]
        light = (1.0 + slope_x**2 + slope_y**2) ** (-0.5 * self.vignetting)
        light = light * (1.0 + self.gradient[0] * (x / (camera.width_px - 1) - 0.5))
        light = light * (1.0 + self.gradient[1] * (y / (camera.height_px - 1) - 0.5))
        return np.asarray(light, np.float32)


def noise_generator(seed: int, image: int) -> np.random.Generator:
    """Return the generator of one image's noise: it depends on nothing but the seed and the image's index."""
    return np.random.default_rng([seed, image])


def expose(light: Picture, camera: Camera, generator: np.random.Generator | None, bits: int = 8) -> NDArray[np.generic]:
    """Turn light into grey levels: shot noise, read noise, clipping, rounding.

    Args:
        light: (h, w), full scale 1 = the camera's full well.
        generator: None for a picture without noise (rounding remains).
        bits: 8 or 16.

    Returns:
        (h, w) uint8 or uint16.
    """
    full_scale = 2**bits - 1
    level: Picture = light
    if generator is not None:
        well = camera.full_well_e
        variance = np.maximum(light, 0.0) / np.float32(well) + np.float32((camera.read_noise_e / well) ** 2)
        level = (light + np.sqrt(variance) * generator.standard_normal(light.shape, np.float32)).astype(np.float32)
    rounded = np.clip(np.rint(level * np.float32(full_scale)), 0, full_scale)
    grey: NDArray[np.generic] = rounded.astype(np.uint8 if bits == 8 else np.uint16)
    return grey


def glare(camera: Camera, count: int, random: np.random.Generator) -> Picture:
    """Return the (h, w) stray light of ``count`` soft spots, up to twice full scale, anywhere in the frame."""
    light = np.zeros((camera.height_px, camera.width_px), np.float32)
    x = np.arange(camera.width_px, dtype=np.float32)[None, :]
    y = np.arange(camera.height_px, dtype=np.float32)[:, None]
    for _ in range(count):
        centre_x, centre_y = random.uniform(0, camera.width_px), random.uniform(0, camera.height_px)
        radius, peak = camera.width_px * random.uniform(0.01, 0.03), random.uniform(0.5, 2.0)
        light += np.float32(peak) * np.exp(-((x - centre_x) ** 2 + (y - centre_y) ** 2) / np.float32(2 * radius**2))
    return light
