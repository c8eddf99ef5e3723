"""The tone curve of photographs: most are stored as level^(1/2.2), and corners of such a picture shrink by 0.1 px.

Every fitted tag shows the bow of the curve between its black and its white (``fit.Fit.bow``). The exponent that is
undone is the one that leaves no bow in the median over the tags of a few pictures, whatever the exposure and the noise.
Blur does not bow: it changes dark and bright alike.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from netdesign.imaging.detect import Sighted, detect
from netdesign.imaging.fit import Fit, fit_tag
from netdesign.imaging.measure import sensor_noise
from netdesign.imaging.pictures import linear
from netdesign.imaging.tags import cells
from netdesign.model.camera import Camera

MOST_TAGS = 40
LINEAR = 0.03  # a bow below it is not told from none: an exponent of 0.04, corners 0.003 px
LIMITS = (0.3, 4.0)  # of the exponent
ROUNDS = 8
TOLERANCE = 0.003  # of the bow


@dataclass(frozen=True, kw_only=True)
class Tone:
    """How pictures were stored.

    Attributes:
        gamma: exponent that makes them linear in light; 1 for linear ones.
        bow: what is left, 0 when the curve is a power.  tags: how many were looked at.
        noise: median chi² per degree of freedom against the camera's sensor model.
    """

    gamma: float
    bow: float
    noise: float
    tags: int


def estimate_tone(
    pictures: Sequence[NDArray[np.generic]], camera: Camera, family: str, ids: Collection[int] | None = None,
    gamma: float | None = None,
) -> Tone:  # fmt: skip
    """Look at the tags of some pictures of one series.

    Args:
        pictures: (h, w) uint8 or uint16 each.  ids: that may occur.
        gamma: when it is known; then only the noise is new.
    """
    seeds: list[tuple[int, Sighted]] = []
    for index, picture in enumerate(pictures):
        seeds += [(index, seed) for seed in detect(picture, family, ids)]
    seeds = seeds[:: max(1, len(seeds) // MOST_TAGS)][:MOST_TAGS]

    def look(exponent: float) -> Tone:
        straight = [picture if exponent == 1.0 else linear(picture, exponent) for picture in pictures]
        fits: list[Fit] = []
        for index, seed in seeds:
            gain, floor = sensor_noise(straight[index], camera)
            pattern = cells(family, seed.tag_id)
            fits.append(fit_tag(straight[index], pattern, seed.corners_px, camera.intrinsics, gain, floor))
        fits = [fit for fit in fits if fit.converged]
        if not fits:
            return Tone(gamma=exponent, bow=0.0, noise=1.0, tags=0)
        bow, noise = np.median([fit.bow for fit in fits]), np.median([fit.chi2_per_dof for fit in fits])
        return Tone(gamma=exponent, bow=float(bow), noise=float(noise), tags=len(fits))

    if gamma is not None:
        return look(gamma)
    plain = look(1.0)
    if plain.tags == 0 or abs(plain.bow) < LINEAR:
        return plain
    now, step = plain, 0.7 if plain.bow > 0 else -0.7
    for _ in range(ROUNDS):
        before, now = now, look(float(np.clip(np.exp(np.log(now.gamma) + step), *LIMITS)))
        change = now.bow - before.bow
        if abs(now.bow) < TOLERANCE or now.tags == 0 or now.gamma == before.gamma or change == 0.0:
            break
        step = float(np.clip(-now.bow * np.log(now.gamma / before.gamma) / change, -0.7, 0.7))
    return now if now.tags and abs(now.bow) < LINEAR else plain
