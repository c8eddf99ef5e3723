"""Measuring one picture: find the tags, fit each, judge each. Nothing is dropped without a reason."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from netdesign.imaging.detect import detect, pose_from_tag
from netdesign.imaging.fit import Fit, fit_tag
from netdesign.imaging.tags import cells
from netdesign.model.arrays import Floats
from netdesign.model.camera import Camera
from netdesign.model.scene import FAMILIES


@dataclass(frozen=True, kw_only=True)
class Gates:
    """When a fitted tag is believed.

    Attributes:
        max_incidence: rad; beyond it the rendered textures, and real print, are no longer well known.
        min_cell_px: shortest edge of the tag divided by its cells.
        chi2_base, chi2_sigmas: largest chi²/dof is base + sigmas·sqrt(2/dof).
        max_seed_shift_cells: largest distance of a corner from its seed, in cells, at least ``min_seed_shift_px``.
        min_contrast: smallest (white - black) / full scale.
        max_clipped: largest share of pixels at full scale in the tag's bounding box: clipping shrinks the black.
        border_px: a tag with a corner nearer to the frame's edge is not measured.
        own_noise: for photographs of an unknown sensor or exposure: the noise is the sensor model times the median
            chi²/dof of the picture's tags, and a tag is judged against that. It cannot see what all tags share.
        noise_scale: the factor for pictures of fewer than FEW tags, from the other pictures of the series.
    """

    max_incidence: float = float(np.radians(70.0))
    min_cell_px: float = 1.5
    chi2_base: float = 1.15
    chi2_sigmas: float = 5.0
    max_seed_shift_cells: float = 0.5
    min_seed_shift_px: float = 3.0
    min_contrast: float = 0.08
    max_clipped: float = 0.02
    border_px: float = 2.0
    own_noise: bool = False
    noise_scale: float = 1.0


FEW = 5  # tags of a picture that cannot judge each other


@dataclass(frozen=True, kw_only=True)
class TagMeasurement:
    """One tag in one picture.

    Attributes:
        corners_px: (4, 2), order TL, TR, BR, BL, origin at the centre of the top-left pixel.
        covariance_px2: (8, 8), order x0 y0 x1 y1 …
        rejected: why the tag must not be used, "" when it may.
        incidence: rad, from the tag's own pose.  The rest as in ``fit.Fit``.
    """

    tag_id: int
    corners_px: Floats
    covariance_px2: Floats
    rejected: str
    chi2_per_dof: float
    pixels: int
    sigma_px: float
    black: float
    white: float
    cell_px: float
    incidence: float
    seed_shift_px: float


def measure(
    picture: NDArray[np.generic], camera: Camera, family: str, size_m: float, ids: Collection[int] | None = None,
    gates: Gates | None = None, floor_px: float = 0.0,
) -> list[TagMeasurement]:  # fmt: skip
    """Measure every tag of a picture that is linear in light.

    Args:
        picture: (h, w) uint8 or uint16.  camera: gives interior orientation and the sensor's noise.
        family, size_m: of the tags.  ids: the ids that may occur; None for all.
        floor_px: systematic error of the method, added to every coordinate's variance.

    Returns:
        One measurement per recognised tag, by id; look at ``rejected`` before use. A tag id that shows more than
        once is rejected wherever it shows.
    """
    judge = gates or Gates()
    full_scale = 65535.0 if picture.dtype == np.uint16 else 255.0
    gain, floor = sensor_noise(picture, camera)
    seeds = detect(picture, family, ids)
    fits = [
        fit_tag(picture, cells(family, seed.tag_id), seed.corners_px, camera.intrinsics, gain, floor) for seed in seeds
    ]
    count = FAMILIES[family].cells
    scale = 1.0
    if judge.own_noise:
        noise = [fit.chi2_per_dof for fit in fits if fit.converged]
        scale = float(np.median(noise)) if len(noise) >= FEW else judge.noise_scale
    measured = []
    for seed, raw in zip(seeds, fits, strict=True):
        fit = replace(raw, covariance_px2=scale * raw.covariance_px2, chi2_per_dof=raw.chi2_per_dof / scale)
        edges = np.linalg.norm(np.roll(fit.corners_px, -1, axis=0) - fit.corners_px, axis=1)
        shift = float(np.linalg.norm(fit.corners_px - seed.corners_px, axis=1).max())
        incidence = _incidence(fit, size_m, camera.intrinsics) if fit.converged else float("nan")
        measured.append(
            TagMeasurement(
                tag_id=seed.tag_id,
                corners_px=fit.corners_px,
                covariance_px2=fit.covariance_px2 + floor_px**2 * np.eye(8),
                rejected=_reason(fit, judge, picture, full_scale, float(edges.min()) / count, shift, incidence),
                chi2_per_dof=fit.chi2_per_dof,
                pixels=fit.pixels,
                sigma_px=fit.sigma_px,
                black=fit.black,
                white=fit.white,
                cell_px=float(edges.min()) / count,
                incidence=incidence,
                seed_shift_px=shift,
            )
        )
    ids_seen = [item.tag_id for item in measured]
    return [
        replace(item, rejected=item.rejected or f"tag {item.tag_id} shows {ids_seen.count(item.tag_id)} times")
        if ids_seen.count(item.tag_id) > 1
        else item
        for item in measured
    ]


def sensor_noise(picture: NDArray[np.generic], camera: Camera) -> tuple[float, float]:
    """Return gain and floor: the variance of a grey level of the picture is gain · level + floor."""
    gain = (65535.0 if picture.dtype == np.uint16 else 255.0) / camera.full_well_e
    return gain, (gain * camera.read_noise_e) ** 2 + 1 / 12


def _incidence(fit: Fit, size_m: float, intrinsics: Floats) -> float:
    """Return the angle (rad) between the tag's normal and the direction to the camera."""
    position = pose_from_tag(fit.corners_px, size_m, intrinsics)[0][0][:3, 3]
    return float(np.arccos(np.clip(position[2] / np.linalg.norm(position), -1.0, 1.0)))


def _white_limit(picture: NDArray[np.generic]) -> float:
    """Return the level at which the picture clips: full scale, or that of 10 to 14 bits stored in 16."""
    largest = int(picture.max(initial=0))
    narrow = {2**bits - 1 for bits in (10, 12, 14)} | {(2**bits - 1) << (16 - bits) for bits in (10, 12, 14)}
    full_scale = 65535 if picture.dtype == np.uint16 else 255
    return float(largest if picture.dtype == np.uint16 and largest in narrow else full_scale)


def _reason(
    fit: Fit, gates: Gates, picture: NDArray[np.generic], full_scale: float, cell_px: float, shift: float,
    incidence: float,
) -> str:  # fmt: skip
    """Return why a fit is not believed, or ""."""
    if not fit.converged:
        return f"fit not converged after {fit.iterations} iterations"
    low, high = fit.corners_px.min(axis=0), fit.corners_px.max(axis=0)
    if (low < gates.border_px).any() or (high > np.array(picture.shape[::-1]) - 1 - gates.border_px).any():
        return "cut by the frame"
    (left, top), (right, bottom) = low.astype(int), high.astype(int) + 1
    clipped = float(np.mean(np.greater_equal(picture[top:bottom, left:right], _white_limit(picture))))
    if clipped > gates.max_clipped:
        return f"{100 * clipped:.1f} % of the pixels clipped, at most {100 * gates.max_clipped:.1f} % allowed"
    if cell_px < gates.min_cell_px:
        return f"cell {cell_px:.2f} px, at least {gates.min_cell_px:.2f} px needed"
    if not incidence <= gates.max_incidence:
        return f"incidence {np.degrees(incidence):.1f} deg, at most {np.degrees(gates.max_incidence):.1f} deg allowed"
    if fit.white - fit.black < gates.min_contrast * full_scale:
        return f"contrast {(fit.white - fit.black) / full_scale:.3f}, at least {gates.min_contrast:.3f} needed"
    shift_limit = max(gates.max_seed_shift_cells * cell_px, gates.min_seed_shift_px)
    if shift > shift_limit:
        return f"corner {shift:.2f} px from its seed, at most {shift_limit:.2f} px allowed"
    limit = gates.chi2_base + gates.chi2_sigmas * float(np.sqrt(2.0 / max(fit.pixels, 1)))
    if fit.chi2_per_dof > limit:
        return f"chi2/dof {fit.chi2_per_dof:.2f}, at most {limit:.2f} allowed"
    return ""
