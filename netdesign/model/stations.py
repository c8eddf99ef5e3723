"""Where cameras may stand: a viewing sphere, or a body around its centre; every camera looks at the centre."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from netdesign.model.arrays import Bools, Floats, frozen
from netdesign.model.frames import look_at, sphere_directions, viewpoints_of

SHELLS = (0.0, 0.25, 0.5, 0.75, 1.0)
ROUNDING = 1e-9  # rad, by which a direction read from a pose may be beside its range


@dataclass(frozen=True, kw_only=True)
class Depth:
    """The interval of distances from the centre that is admissible in every direction.

    Attributes:
        shape: ellipsoid (a sphere too): from the inner to the outer one; box: whatever lies inside.
        low, high: (3,) m, semi-axes of the inner and outer ellipsoid along the world axes, or the lowest and highest
            corner of the box relative to the centre.
    """

    shape: Literal["ellipsoid", "box"]
    low: Floats
    high: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", frozen("low", self.low, (3,)))
        object.__setattr__(self, "high", frozen("high", self.high, (3,)))

    @property
    def has_width(self) -> bool:
        """Whether the least and the largest distance differ."""
        return self.shape == "box" or bool((self.low != self.high).any())

    def limits(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the least and largest distance (…) along unit directions (…, 3), m; least > largest: none."""
        if self.shape == "ellipsoid":
            near, far = (1.0 / np.linalg.norm(directions / axes, axis=-1) for axes in (self.low, self.high))
            return near, far
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = self.low / directions, self.high / directions
        parallel = directions == 0.0
        inside = (self.low <= 0.0) & (self.high >= 0.0)
        enter = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(one, other)).max(axis=-1)
        leave = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(one, other)).min(axis=-1)
        return np.maximum(enter, 0.0), leave

    def limits_around(self, directions: Floats, chord: Floats) -> tuple[Floats, Floats]:
        """Return bounds (…) of all distances within the body along the unit vectors within ``chord`` of a direction.

        Args:
            directions: (…, 3) unit.  chord: (…) largest distance between a unit vector and its direction.

        Along every such vector v and for every admissible r: least <= r <= largest; least > largest: there is none.
        """
        if self.shape == "ellipsoid":
            # |v / a| differs by at most chord / min a; the axes themselves bound it too.
            lower = np.linalg.norm(directions / self.low, axis=-1) + chord / self.low.min()
            upper = np.linalg.norm(directions / self.high, axis=-1) - chord / self.high.min()
            far = np.where(upper > 0.0, 1.0 / np.where(upper > 0.0, upper, 1.0), np.inf)
            return np.maximum(1.0 / lower, self.low.min()), np.minimum(far, self.high.max())
        # r v lies in the box: its components are at least r (d - chord) and at most r (d + chord).
        farthest = float(np.linalg.norm(np.maximum(np.abs(self.low), np.abs(self.high))))
        near, far = np.zeros(directions.shape[:-1]), np.full(directions.shape[:-1], farthest)
        for sign, edge in ((1.0, self.low), (-1.0, -self.high)):
            reach = sign * directions + chord[..., None]  # r · reach >= edge must be possible
            quotient = edge / np.where(reach == 0.0, 1.0, reach)
            least = np.where(reach > 0.0, quotient, np.where(edge > 0.0, np.inf, 0.0))
            largest = np.where((reach < 0.0) & (edge <= 0.0), quotient, np.inf)
            near, far = np.maximum(near, least.max(axis=-1)), np.minimum(far, largest.min(axis=-1))
        return near, far


@dataclass(frozen=True, kw_only=True)
class ViewingSphere:
    """The admissible stations: cameras on a sphere, or within a depth about it, that look at its centre.

    A viewpoint is (alpha, beta), or (alpha, beta, t) when there is a depth: t in [0, 1] goes from its least to its
    largest distance.

    Attributes:
        centre: (3,) m, world frame.  radius: m; with a depth the largest distance of a station.
        azimuth, elevation: (low, high) in rad, of alpha and beta.
        roll: rad about the optical axis, None when the robot is free to choose it.
        max_images: length of the structured chromosome.
        depth: None for stations on the sphere itself.
    """

    centre: Floats
    radius: float
    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    roll: float | None
    max_images: int
    depth: Depth | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", frozen("centre", self.centre, (3,)))

    @property
    def genes(self) -> int:
        """How many numbers say where a station is: 2, or 3 with a depth."""
        return 2 if self.depth is None else 3

    def radii(self, viewpoints: Floats) -> Floats:
        """Return the distances (…) m of viewpoints (…, 2 or 3) from the centre; NaN where no station is admissible."""
        if self.depth is None:
            return np.full(viewpoints.shape[:-1], float(self.radius))
        near, far = self.depth.limits(sphere_directions(viewpoints))
        share = viewpoints[..., 2] if viewpoints.shape[-1] == 3 else 0.5
        there = near <= far
        near, far = np.where(there, near, np.nan), np.where(there, far, np.nan)
        return np.asarray(near + share * (far - near))

    def admissible(self, viewpoints: Floats) -> Bools:
        """Return (…) whether there is a station at viewpoints (…, 2 or 3) within the ranges of the angles."""
        return np.isfinite(self.radii(viewpoints))

    def cameras(self, viewpoints: Floats, roll: Floats | float | None = None) -> Floats:
        """Return world_from_cam (…, 4, 4) of admissible viewpoints (…, 2 or 3); roll defaults to the sphere's."""
        position = self.centre + self.radii(viewpoints)[..., None] * sphere_directions(viewpoints)
        return look_at(position, self.centre, (self.roll or 0.0) if roll is None else roll)

    def placed(self, world_from_cam: Floats) -> tuple[Floats, Floats]:
        """Return (alpha, beta) rad (…, 2) and distance m (…) of stations (…, 4, 4) as seen from the centre.

        Alpha is counted as the study counts it, within the range of azimuths, be it beyond ±pi; in (-pi, pi] for
        stations outside of the range. Straight above or below, where it means nothing, it is the range's value
        nearest 0.
        """
        offset = world_from_cam[..., :3, 3] - self.centre
        viewpoints = viewpoints_of(offset)
        alpha, (low, high) = viewpoints[..., 0], self.azimuth
        counted = low + np.mod(alpha - low + ROUNDING, 2.0 * np.pi) - ROUNDING
        inside = np.where(counted <= high + ROUNDING, np.clip(counted, low, high), alpha)
        pole = np.hypot(offset[..., 0], offset[..., 1]) <= ROUNDING * np.abs(offset[..., 2])
        viewpoints[..., 0] = np.where(pole, np.clip(0.0, low, high), inside)
        return viewpoints, np.linalg.norm(offset, axis=-1)

    def sample(self, step: float) -> tuple[Floats, Floats]:
        """Return viewpoints (c, 2 or 3) in the middle of equal steps and their shares (c,) of the area.

        With a depth: on each of SHELLS, at twice the step (rad).
        """
        step = step if self.depth is None else 2.0 * step
        (low_a, high_a), (low_b, high_b) = self.azimuth, self.elevation
        rows, columns = max(1, round((high_b - low_b) / step)), max(1, round((high_a - low_a) / step))
        edges = np.linspace(low_b, high_b, rows + 1)
        alpha = np.linspace(low_a, high_a, columns + 1)[:-1] + 0.5 * (high_a - low_a) / columns
        beta = 0.5 * (edges[1:] + edges[:-1])
        share = np.diff(np.sin(edges)) / (np.sin(edges[-1]) - np.sin(edges[0])) / columns
        viewpoints, shares = (
            np.stack([np.tile(alpha, rows), np.repeat(beta, columns)], axis=1),
            np.repeat(share, columns),
        )
        if self.depth is None:
            return viewpoints, shares
        there = self.admissible(viewpoints)
        viewpoints, shares = viewpoints[there], shares[there]
        shells = SHELLS if self.depth.has_width else (0.5,)
        stations = np.concatenate([np.column_stack([viewpoints, np.full(len(viewpoints), t)]) for t in shells])
        return stations, np.tile(shares / max(float(shares.sum()), 1e-300) / len(shells), len(shells))
