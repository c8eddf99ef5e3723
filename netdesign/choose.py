"""The front as a table, and one network of it with the reason in words."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InputError
from netdesign.files.store import read_json
from netdesign.files.study import load_task
from netdesign.model.arrays import Floats
from netdesign.model.study import DistanceRequirement, Study
from netdesign.model.task import Task
from netdesign.placement.decide import Requirement, admissible, cheapest, knee
from netdesign.placement.distances import distance_u95

MM = 1e-3


@dataclass(frozen=True, kw_only=True)
class FrontRow:
    """One network of the front, in the units of its keys; None: not computed.

    ``tour`` is in ``tour_unit``; ``verdict`` is that of the validation, "not validated" before it.
    """

    network: int
    images: int
    rms_sigma_um: float
    max_sigma_um: float
    total_rms_sigma_um: float | None
    bound_ratio: float | None
    tour: float
    tour_unit: str
    knee: bool
    verdict: str


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The chosen network and why.

    Attributes:
        rule: "knee" or "requirements".  reason, warnings: sentences.
        requirements: name, limit, value and unit of everything that was asked for.
        row: the network's line of the front.
    """

    network: int
    rule: str
    reason: str
    row: FrontRow
    requirements: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        return asdict(self)


def front(run: Path) -> list[FrontRow]:
    """Return the front of a run, sorted by number of images, then precision.

    Raises:
        InputError: RUN/design.json is missing or not a design.
    """
    design = read_design(run)
    networks = design["networks"]
    best = networks[knee(objectives_of(design))]["id"]
    unit = design["objectives"][1]["unit"]
    rows = [
        FrontRow(
            network=network["id"],
            images=int(network["objectives"][2]),
            rms_sigma_um=network["rms_sigma_um"],
            max_sigma_um=network["max_sigma_um"],
            total_rms_sigma_um=network.get("total_rms_sigma_um"),
            bound_ratio=network.get("bound_ratio"),
            tour=network["objectives"][1],
            tour_unit=unit,
            knee=network["id"] == best,
            verdict=_verdict(run, network["id"]),
        )
        for network in networks
    ]
    return sorted(rows, key=lambda row: (row.images, row.rms_sigma_um, row.network))


def choose(
    run: Path,
    knee_point: bool = False,
    max_sigma_um: float | None = None,
    max_images: int | None = None,
    max_tour: float | None = None,
) -> Choice:
    """Pick one network of a run's front.

    With limits: the cheapest network (fewest images, then shortest tour) that meets them; with limits and
    ``knee_point``: the knee among those that meet them. Limits not given here come from the study's [requirements];
    without any, the knee.

    Raises:
        InputError: RUN/design.json is missing, a limit is not positive, or a distance names an unknown object point.
        InfeasibleError: no network meets the limits; names the one that binds and the best that can be had.
    """
    for name, limit in (("--max-sigma-um", max_sigma_um), ("--max-images", max_images), ("--max-tour", max_tour)):
        if limit is not None and not (limit > 0 and np.isfinite(limit)):
            raise InputError(f"{name}: expected a positive number, found {limit:g}")
    design = read_design(run)
    objectives, networks = objectives_of(design), design["networks"]
    # Only a flag alone can be answered without the study file; its distances need the scene.
    task = load_task(run / "study.toml") if (run / "study.toml").is_file() else None
    study = None if task is None else task.study
    requirements = _requirements(design, study, max_sigma_um, max_images, max_tour)
    if task is not None:
        requirements += [_distance(design, task, asked) for asked in task.study.requirements.distances]
    met = admissible(requirements, len(networks))
    by_knee = knee_point or not requirements
    index = knee(objectives, met) if by_knee else cheapest(objectives, met)
    rows = front(run)
    row = next(row for row in rows if row.network == networks[index]["id"])
    asked = tuple(
        {"name": item.name, "limit": item.limit, "value": float(item.values[index]), "unit": item.unit}
        for item in requirements
    )
    words = _words(row)
    if by_knee:
        reason = f"{words} is the knee of the front" + (" among those that meet the requirements" if asked else "")
        reason += ": " + _trade(row, [other for other in rows if not asked or met[_index(networks, other.network)]])
    else:
        reason = f"{words} is the cheapest of {int(met.sum())} networks that meet: " + "; ".join(
            f"{item['name']} {item['value']:.4g} of at most {item['limit']:g} {item['unit']}".rstrip() for item in asked
        )
    return Choice(
        network=row.network,
        rule="knee" if by_knee else "requirements",
        reason=reason,
        row=row,
        requirements=asked,
        warnings=_warnings(networks[index], row, asked),
    )


def read_design(run: Path) -> dict[str, Any]:
    """Return the content of RUN/design.json.

    Raises:
        InputError: missing, not a design, or without networks.
    """
    design = read_json(run / "design.json", "design")
    if not design.get("networks"):
        raise InputError(f"{run / 'design.json'}: expected at least one network, found none")
    return design


def objectives_of(design: dict[str, Any]) -> Floats:
    """Return (p, 3) the objectives as they stand in the file; an undetermined precision is inf."""
    rows = [[np.inf if value is None else value for value in item["objectives"]] for item in design["networks"]]
    return np.array(rows, dtype=np.float64)


def _requirements(
    design: dict[str, Any],
    study: Study | None,
    max_sigma_um: float | None,
    max_images: int | None,
    max_tour: float | None,
) -> list[Requirement]:
    """Return the limits on what stands in design.json; a flag goes before the study's own."""
    networks, objectives = design["networks"], objectives_of(design)
    own = None if study is None else study.requirements
    sigma = np.array([np.inf if item["max_sigma_um"] is None else item["max_sigma_um"] for item in networks])
    candidates = (
        ("largest point sigma", "µm", max_sigma_um, own and own.max_sigma_um, sigma),
        ("number of images", "", max_images, own and own.max_images, objectives[:, 2]),
        ("tour", design["objectives"][1]["unit"], max_tour, own and own.max_tour, objectives[:, 1]),
    )
    return [
        Requirement(name=name, unit=unit, limit=float(limit), values=values)
        for name, unit, flag, default, values in candidates
        if (limit := default if flag is None else flag) is not None
    ]


def _distance(design: dict[str, Any], task: Task, asked: DistanceRequirement) -> Requirement:
    """Return the requirement on one distance, its U95 (k = 2) from the total covariance of every network."""
    ids = task.scene.targets.point_ids
    for name in (asked.from_, asked.to):
        if name not in ids:
            raise InputError(f"study.toml: requirements.distances: expected tag.corner of the part, found {name!r}")
    ends = (ids.index(asked.from_), ids.index(asked.to))
    values = [
        distance_u95(task, np.array(item["world_from_cam_mm"]) * _MM_ROWS, ends) * 1e6 for item in design["networks"]
    ]
    name = f"U95 of the distance {asked.from_} to {asked.to}"
    return Requirement(name=name, unit="µm", limit=asked.u95_um, values=np.array(values))


_MM_ROWS = np.array([[1, 1, 1, MM]] * 3 + [[1, 1, 1, 1]])  # translation of a 4x4 from mm to m


def _words(row: FrontRow) -> str:
    total = "" if row.total_rms_sigma_um is None else f" ({row.total_rms_sigma_um:.1f} µm with total error propagation)"
    return (
        f"network {row.network:04d} with {row.images} images, rms sigma {row.rms_sigma_um:.1f} µm{total} "
        f"and a tour of {row.tour:.4g} {row.tour_unit}"
    )


def _trade(row: FrontRow, rows: list[FrontRow]) -> str:
    """Return what the neighbours of the knee cost and give: the cheaper ones and the more precise ones."""
    parts = []
    fewer = [other for other in rows if other.images < row.images]
    if fewer:
        other = max(fewer, key=lambda item: (item.images, -item.rms_sigma_um))
        parts.append(f"{_images(row.images - other.images)} fewer make sigma {_factor(other, row)} as large")
    more = [other for other in rows if other.images > row.images]
    if more:
        other = min(more, key=lambda item: (item.images, item.rms_sigma_um))
        parts.append(f"{_images(other.images - row.images)} more bring it to {_factor(other, row)} of that")
    return "; ".join(parts) if parts else "no other size to compare with"


def _factor(other: FrontRow, row: FrontRow) -> str:
    return f"{other.rms_sigma_um / row.rms_sigma_um:.2f} times"


def _images(count: int) -> str:
    return "1 image" if count == 1 else f"{count} images"


def _warnings(network: dict[str, Any], row: FrontRow, asked: tuple[dict[str, Any], ...]) -> tuple[str, ...]:
    """Return the network's own warnings and what the requirement on sigma does not say."""
    found = [str(item) for item in network.get("warnings", ())]
    total = network.get("total_max_sigma_um")
    for item in asked:
        if item["name"] == "largest point sigma" and total is not None and total > item["limit"]:
            found.append(
                f"with total error propagation the largest point sigma is {total:.4g} µm, above the {item['limit']:g} µm"
            )
    if row.verdict not in ("not validated", "pass"):
        found.append(f"the validation of this network says: {row.verdict}")
    return tuple(found)


def _verdict(run: Path, network: int) -> str:
    path = run / "networks" / f"{network:04d}" / "validation.json"
    return str(read_json(path, "validation").get("verdict", "no verdict")) if path.is_file() else "not validated"


def _index(networks: list[dict[str, Any]], network: int) -> int:
    return next(index for index, item in enumerate(networks) if item["id"] == network)
