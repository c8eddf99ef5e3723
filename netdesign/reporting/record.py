"""What a report is made of: a run read back, nothing of it left out."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from netdesign.model.arrays import Bools, Floats, Ints
from netdesign.model.scene import CORNERS_PER_TAG
from netdesign.model.task import Task
from netdesign.reporting.arm import Arm

UM = 1e-6


@dataclass(frozen=True, kw_only=True)
class NetworkRecord:
    """One network of the front.

    Attributes:
        planned: its entry in design.json.
        world_from_cam: (n, 4, 4) m, in visiting order.
        visible_tags: (n, g) which image sees which tag, from exact rays.
        limited, total: (m, 3, 3) m², recomputed for the report from the poses; inf where undetermined.
        vias: via points (k, r) rad of the legs that have them, by number of the leg.
        legs: (n - 1,) lengths of the legs over their via points, in the unit of the tour, without the dwell.
        without: (n,) rms sigma in m, limited, if one image were lost; inf when a point is then undetermined.
        datum: of ``total``.  determined: the rank test of the total propagation.  diagnosis: what it complains about.
        validation, adjustment: contents of the network's files; None when they do not exist.
        repeats: validations of further realisations of the same network.
        thumbnails: (file name, JPEG bytes) of a few of its images.
    """

    planned: dict[str, Any]
    world_from_cam: Floats
    visible_tags: Bools
    limited: Floats
    total: Floats
    vias: dict[int, Floats]
    legs: Floats
    without: Floats
    datum: str
    determined: bool
    diagnosis: tuple[str, ...]
    validation: dict[str, Any] | None
    adjustment: dict[str, Any] | None
    repeats: tuple[dict[str, Any], ...] = ()
    thumbnails: tuple[tuple[str, bytes], ...] = ()

    @property
    def id(self) -> int:
        """The network's number."""
        return int(self.planned["id"])

    @property
    def name(self) -> str:
        """The number as its folder is called."""
        return f"{self.id:04d}"

    @property
    def images(self) -> int:
        """Number of images."""
        return len(self.world_from_cam)

    @property
    def rays(self) -> Ints:
        """(m,) images that see each object point."""
        return np.repeat(self.visible_tags.sum(axis=0), CORNERS_PER_TAG)

    @property
    def tour(self) -> float:
        """Length of the tour in the unit of f2."""
        return float(self.planned["objectives"][1])

    @property
    def rms_um(self) -> float:
        """The rms sigma over all coordinates, limited error propagation."""
        return _number(self.planned["rms_sigma_um"])

    @property
    def max_um(self) -> float:
        """The largest sigma of a coordinate, limited error propagation."""
        return _number(self.planned["max_sigma_um"])

    @property
    def total_rms_um(self) -> float:
        """The rms sigma with total error propagation."""
        value = self.planned.get("total_rms_sigma_um")
        return rms_um(self.total) if value is None else float(value)

    @property
    def total_max_um(self) -> float:
        """The largest sigma with total error propagation."""
        return float(np.sqrt(np.diagonal(self.total, axis1=1, axis2=2).max())) / UM

    @property
    def bound_ratio(self) -> float | None:
        """f1 over its proven lower bound."""
        value = self.planned.get("bound_ratio")
        return None if value is None else float(value)

    @property
    def verdict(self) -> str:
        """The worst verdict of its validations, or "not validated"."""
        found = [str(content["verdict"]) for content in (self.validation, *self.repeats) if content is not None]
        return next((verdict for verdict in ("failed", "fail", "pass") if verdict in found), "not validated")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Everything that flags this network, each sentence once."""
        found = [*self.planned.get("warnings", ()), *self.diagnosis]
        for content in (self.validation, self.adjustment):
            found += [] if content is None else content.get("warnings", [])
        return tuple(dict.fromkeys(str(item) for item in found))


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """A run: the study, the front, and the proof as far as it goes.

    Attributes:
        design: the content of design.json.  campaign: that of RUN/validation.json, or None.
        knee: id of the network recommended when nothing is asked.  reason: why, in words.
        arm: the robot, when the study has one.
        recomputed: largest relative difference of f1 between design.json and the report's own computation.
    """

    task: Task
    design: dict[str, Any]
    networks: tuple[NetworkRecord, ...]
    campaign: dict[str, Any] | None
    knee: int
    reason: str
    recomputed: float
    arm: Arm | None = None

    @property
    def precision_name(self) -> str:
        """What f1 is, as an axis says it in micrometres."""
        return "largest sigma" if self.task.study.objectives.precision == "max_sigma" else "rms sigma"

    @property
    def tour_unit(self) -> str:
        """Unit of f2."""
        return str(self.design["objectives"][1]["unit"])

    def precision_um(self, network: NetworkRecord) -> float:
        """Return f1 of a network as a sigma in µm: its square root for the mean variance."""
        value = network.planned["objectives"][0]
        return float("inf") if value is None else self.as_um(float(value))

    def as_um(self, f1: float) -> float:
        """Return a value of f1, in its own unit, as a sigma in µm."""
        return 1e3 * float(np.sqrt(f1)) if self.design["objectives"][0]["unit"] == "mm^2" else f1

    def bounds_um(self) -> list[tuple[int, float]]:
        """Return (number of images, lower bound as a sigma in µm) wherever one was proved."""
        found = {}
        for network in self.networks:
            ratio, value = network.bound_ratio, network.planned["objectives"][0]
            if ratio and value is not None:
                found[network.images] = self.as_um(float(value) / ratio)
        return sorted(found.items())


def rms_um(covariance: Floats) -> float:
    """Return the rms sigma in µm over all coordinates of covariances (m, 3, 3) m²."""
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).sum() / (3 * len(covariance)))) / UM


def _number(value: float | None) -> float:
    return float("inf") if value is None else float(value)
