"""The front as a table, and one network of it with the reason in words."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InfeasibleError, InputError
from netdesign.files.design_json import read_design
from netdesign.files.store import plain, read_json
from netdesign.model.arrays import Bools, Floats
from netdesign.model.figures import significant
from netdesign.model.task import Task
from netdesign.photogrammetry.total_error import FLAG_RATIO
from netdesign.placement import decide
from netdesign.placement.decide import Requirement
from netdesign.placement.distances import SIGMA, distance_name, distance_u95, named_ends
from netdesign.run_folder import open_run

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

    @property
    def record(self) -> dict[str, Any]:
        """What ``--json`` prints."""
        return plain(asdict(self))  # type: ignore[no-any-return]

    @property
    def text(self) -> str:
        """What a person reads: the reason, then the warnings, a line each."""
        return "\n".join([self.reason[0].upper() + self.reason[1:], *(f"warning: {item}" for item in self.warnings)])


def front(run: Path) -> list[dict[str, Any]]:
    """Return the front of a run as flat records with the keys of ``FrontRow``.

    Raises:
        InputError: RUN/design.json is missing or not a design.
    """
    return [plain(asdict(row)) for row in front_rows(run)]


def front_rows(run: Path) -> list[FrontRow]:
    """Return the front of a run, sorted by number of images, then precision.

    Raises:
        InputError: RUN/design.json is missing or not a design.
    """
    design = read_design(run / "design.json")
    networks = design["networks"]
    best = networks[_knee(design, np.ones(len(networks), dtype=bool))]["id"]
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
    *,
    knee: bool = False,
    max_sigma_um: float | None = None,
    max_images: int | None = None,
    max_tour: float | None = None,
) -> Choice:
    """Pick one network of a run's front.

    With limits: the cheapest network (fewest images, then shortest tour) that meets them; with limits and
    ``knee``: the knee among those that meet them. Without any limit and without ``knee`` the study's [requirements]
    count; when there are none either, the knee.

    Raises:
        InputError: RUN/design.json is missing, a limit is not positive, or a distance names an unknown object point.
        InfeasibleError: no network meets the limits; names the one that binds and the best that can be had.
    """
    for name, limit in (("--max-sigma-um", max_sigma_um), ("--max-images", max_images), ("--max-tour", max_tour)):
        if limit is not None and not (limit > 0 and np.isfinite(limit)):
            raise InputError(f"{name}: expected a positive number, found {limit:g}")
    design = read_design(run / "design.json")
    objectives, networks = objectives_of(design), design["networks"]
    task = open_run(run)
    own = task.study.requirements
    asked_here = knee or any(limit is not None for limit in (max_sigma_um, max_images, max_tour))
    if asked_here:
        requirements = _limits(design, max_sigma_um, max_images, max_tour)
    else:
        requirements = _limits(design, own.max_sigma_um, own.max_images, own.max_tour) + _distances(design, task)
    answer = design.get("answer")
    if not asked_here and answer is not None and not answer["met"]:
        raise InfeasibleError(answer["reason"])
    met = decide.admissible(requirements, objectives[:, 2])
    by_knee = knee or not requirements
    index = _knee(design, met) if by_knee else decide.cheapest(objectives, met)
    rows = front_rows(run)
    row = next(row for row in rows if row.network == networks[index]["id"])
    asked: tuple[dict[str, Any], ...] = tuple(
        {"name": item.name, "limit": item.limit, "value": float(item.values[index]), "unit": item.unit}
        for item in requirements
    )
    words = _words(row)
    if by_knee:
        reason = f"{words} is the knee of the front" + (" among those that meet the requirements" if asked else "")
        reason += ": " + _trade(row, [other for other in rows if not asked or met[_index(networks, other.network)]])
    else:
        reason = f"{words} is the cheapest of {int(met.sum())} networks that meet: " + "; ".join(
            f"{item['name']} {significant(item['value'])} of at most {item['limit']:g} {item['unit']}".rstrip()
            for item in asked
        )
    return Choice(
        network=row.network,
        rule="knee" if by_knee else "requirements",
        reason=reason,
        row=row,
        requirements=asked,
        warnings=_warnings(networks[index], row, asked),
    )


def objectives_of(design: dict[str, Any]) -> Floats:
    """Return (p, 3) the objectives as they stand in the file; an undetermined precision is inf."""
    rows = [[np.inf if value is None else value for value in item["objectives"]] for item in design["networks"]]
    return np.array(rows, dtype=np.float64)


def poses_of(network: dict[str, Any]) -> Floats:
    """Return world_from_cam (n, 4, 4) in m of a network of design.json."""
    poses = np.array(network["world_from_cam_mm"], dtype=np.float64)
    poses[:, :3, 3] *= MM
    return poses


def _knee(design: dict[str, Any], admissible: Bools) -> int:
    """Return the knee of the networks that total error propagation does not flag, of all when it flags every one."""
    sound = admissible & ~np.array([_flagged(item) for item in design["networks"]])
    return decide.knee(objectives_of(design), sound if sound.any() else admissible)


def _flagged(network: dict[str, Any]) -> bool:
    limited, total = network["rms_sigma_um"], network.get("total_rms_sigma_um")
    return bool(network.get("flagged")) or total is None or limited is None or (total / limited) ** 2 > FLAG_RATIO


def _limits(
    design: dict[str, Any], max_sigma_um: float | None, max_images: int | None, max_tour: float | None
) -> list[Requirement]:
    """Return the limits on what stands in design.json."""
    objectives = objectives_of(design)
    sigma = [np.inf if item["max_sigma_um"] is None else item["max_sigma_um"] for item in design["networks"]]
    candidates = (
        (SIGMA, "µm", max_sigma_um, np.array(sigma)),
        ("number of images", "", max_images, objectives[:, 2]),
        ("tour", design["objectives"][1]["unit"], max_tour, objectives[:, 1]),
    )
    return [
        Requirement(name=name, unit=unit, limit=float(limit), values=values)
        for name, unit, limit, values in candidates
        if limit is not None
    ]


def _distances(design: dict[str, Any], task: Task) -> list[Requirement]:
    """Return the requirements on distances, their U95 (k = 2) from the total covariance of every network."""
    asked = task.study.requirements.distances
    if not asked:
        return []
    ends = named_ends(task)
    values = np.array([distance_u95(task, poses_of(network), ends) for network in design["networks"]]) * 1e6
    return [
        Requirement(name=distance_name(item.from_, item.to), unit="µm", limit=item.u95_um, values=values[:, index])
        for index, item in enumerate(asked)
    ]


def _words(row: FrontRow) -> str:
    total = ""
    if row.total_rms_sigma_um is not None:
        total = f" ({significant(row.total_rms_sigma_um, 3)} µm with total error propagation)"
    return (
        f"network {row.network:04d} with {row.images} images, rms sigma {significant(row.rms_sigma_um, 3)} µm{total} "
        f"and a tour of {significant(row.tour)} {row.tour_unit}"
    )


def _trade(row: FrontRow, rows: list[FrontRow]) -> str:
    """Return what the neighbours of the knee cost and give: the cheaper ones and the more precise ones."""
    parts = []
    fewer = [other for other in rows if other.images < row.images]
    if fewer:
        other = max(fewer, key=lambda item: (item.images, -item.rms_sigma_um))
        parts.append(f"with {_images(row.images - other.images)} fewer, sigma is {_factor(other, row)} as large")
    more = [other for other in rows if other.images > row.images]
    if more:
        other = min(more, key=lambda item: (item.images, item.rms_sigma_um))
        parts.append(f"with {_images(other.images - row.images)} more, {_factor(other, row)}")
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
        if item["name"] == SIGMA and total is not None and total > item["limit"]:
            found.append(
                f"with total error propagation the largest point sigma is {total:.4g} µm, "
                f"above the {item['limit']:g} µm"
            )
    if row.verdict not in ("not validated", "pass"):
        found.append(f"the validation of this network says: {row.verdict}")
    return tuple(found)


def _verdict(run: Path, network: int) -> str:
    """Return the worst verdict over the realisations of a network: failed, fail or pass."""
    folder = run / "networks" / f"{network:04d}"
    paths = [folder / "validation.json", *sorted(folder.glob("repeat-*/validation.json"))]
    found = [read_json(path, "network-validation")["verdict"] for path in paths if path.is_file()]
    return next((verdict for verdict in ("failed", "fail", "pass") if verdict in found), "not validated")


def _index(networks: list[dict[str, Any]], network: int) -> int:
    return next(index for index, item in enumerate(networks) if item["id"] == network)
