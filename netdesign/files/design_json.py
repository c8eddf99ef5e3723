"""RUN/design.json: the front, written from a Design and read back as plain networks."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.errors import InputError
from netdesign.files.store import read_json, write_json
from netdesign.model.arrays import Floats, frozen
from netdesign.model.camera import Camera
from netdesign.model.results import Design, DesignedNetwork, PointPrecision
from netdesign.model.task import Task

MM, UM = 1e-3, 1e-6
F1 = {"mean_variance": ("mean_variance", "mm^2", MM**2), "max_sigma": ("max_sigma", "um", UM)}
F2 = {"workspace": ("tour_workspace", "mm", MM), "joint": ("tour_joint", "rad", 1.0), "time": ("tour_time", "s", 1.0)}

NEEDED = (
    "id", "objectives", "viewpoints_deg", "world_from_cam_mm", "joints_rad", "rms_sigma_um", "max_sigma_um",
    "bound_ratio", "rays", "sigma_um",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PlannedNetwork:
    """One network as design.json holds it, in SI units and visiting order.

    Attributes:
        viewpoints: (n, 2) rad.  world_from_cam: (n, 4, 4) m.  joints: (n, r) rad or None.
        vias: via points (k, r) rad of the legs that have them; leg i leaves station i.
    """

    id: int
    viewpoints: Floats
    world_from_cam: Floats
    joints: Floats | None
    vias: dict[int, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewpoints", frozen("viewpoints", self.viewpoints, ("n", 2)))
        object.__setattr__(
            self, "world_from_cam", frozen("world_from_cam", self.world_from_cam, (len(self.viewpoints), 4, 4))
        )


def write_design(path: Path, task: Task, design: Design) -> None:
    """Write the front; lengths in mm, sigmas in um, angles in deg where the key says so."""
    objectives = task.study.objectives
    f1_name, f1_unit, f1_scale = F1[objectives.precision]
    f2_name, f2_unit, f2_scale = F2[task.study.motion]
    targets = task.scene.targets
    payload = {
        "name": task.study.name,
        "seed": task.study.seed,
        "objectives": [
            {"name": f1_name, "unit": f1_unit, "propagation": objectives.propagation},
            {"name": f2_name, "unit": f2_unit},
            {"name": "images", "unit": "1"},
        ],
        "points": [
            {"id": name, "xyz_mm": xyz / MM, "normal": normal}
            for name, xyz, normal in zip(targets.point_ids, targets.points, targets.point_normals, strict=True)
        ],
        "camera": _camera(task),
        "history": {"evaluations": design.history.evaluations, "hypervolume": design.history.hypervolume},
        "bounds": [{"images": size, "f1_mm2": bound / MM**2} for size, bound in sorted(design.bounds.items())],
        "notes": list(design.notes),
        "answer": None
        if design.answer_reason is None
        else {"network": design.answer, "reason": design.answer_reason, "met": design.answer is not None},
        "networks": [_network(number, network, (f1_scale, f2_scale)) for number, network in enumerate(design.networks)],
    }
    write_json(path, "design", payload, task.sha256)


def read_design(path: Path) -> dict[str, Any]:
    """Return the content of a design.json whose networks are whole: what reads it further need not look again.

    Raises:
        InputError: missing, not a design, without networks, or a network lacks a key or its poses.
    """
    content = read_json(path, "design")
    networks = content.get("networks")
    if not isinstance(networks, list) or not networks:
        raise InputError(f"{path}: expected at least one network, found none")
    for place, entry in enumerate(networks):
        missing = [key for key in NEEDED if not isinstance(entry, dict) or key not in entry]
        if missing:
            raise InputError(f"{path}: networks[{place}]: expected {', '.join(NEEDED)}, found no {missing[0]}")
        try:
            poses = np.array(entry["world_from_cam_mm"], dtype=np.float64)
            viewpoints = np.array(entry["viewpoints_deg"], dtype=np.float64)
        except (TypeError, ValueError):
            poses, viewpoints = np.zeros(0), np.zeros(0)
        if poses.shape != (len(viewpoints), 4, 4) or viewpoints.shape != (len(poses), 2) or not len(poses):
            raise InputError(
                f"{path}: networks[{place}]: expected n poses 4x4 in world_from_cam_mm and n pairs in viewpoints_deg,"
                " found something else"
            )
    return content


def read_networks(run: Path) -> dict[int, PlannedNetwork]:
    """Return the networks of RUN/design.json by id.

    Raises:
        InputError: there is no design.json, or it is not one.
    """
    content = read_design(run / "design.json")
    networks = {}
    for entry in content["networks"]:
        world_from_cam = np.array(entry["world_from_cam_mm"], dtype=np.float64)
        world_from_cam[:, :3, 3] *= MM
        networks[int(entry["id"])] = PlannedNetwork(
            id=int(entry["id"]),
            viewpoints=np.radians(entry["viewpoints_deg"]),
            world_from_cam=world_from_cam,
            joints=None if entry["joints_rad"] is None else np.array(entry["joints_rad"]),
            vias=vias_of(entry),
        )
    return networks


def vias_of(entry: dict[str, Any]) -> dict[int, Floats]:
    """Return the via points (k, r) rad of a network's entry by number of the leg; earlier versions wrote none."""
    legs = entry.get("vias_rad") or []
    return {leg: np.array(points, dtype=np.float64) for leg, points in enumerate(legs) if points}


def read_unmet(run: Path) -> str | None:
    """Return why no network of RUN/design.json keeps the study's requirements; None when one does or none are asked.

    Raises:
        InputError: there is no design.json, or it is not one.
    """
    answer = read_json(run / "design.json", "design").get("answer")
    return None if answer is None or answer["met"] else str(answer["reason"])


def find_network(run: Path, number: int) -> PlannedNetwork:
    """Return one network of RUN/design.json.

    Raises:
        InputError: there is no such network; the message says which there are.
    """
    networks = read_networks(run)
    if number not in networks:
        raise InputError(f"--network: expected an id from 0 to {len(networks) - 1} of {run}, found {number}")
    return networks[number]


def _network(number: int, network: DesignedNetwork, scales: tuple[float, float]) -> dict[str, Any]:
    world_from_cam_mm = network.world_from_cam.copy()
    world_from_cam_mm[:, :3, 3] /= MM
    total = network.total
    return {
        "id": number,
        "objectives": [network.f1 / scales[0], network.f2 / scales[1], network.f3],
        "viewpoints_deg": np.degrees(network.viewpoints),
        "radius_mm": None if network.radius is None else network.radius / MM,
        "world_from_cam_mm": world_from_cam_mm,
        "joints_rad": network.tour.joints,
        "vias_rad": None
        if network.tour.joints is None
        else [network.tour.vias.get(leg, np.zeros((0, 0))) for leg in range(network.f3 - 1)],
        "rms_sigma_um": _rms_um(network.precision),
        "max_sigma_um": float(network.precision.sigma.max()) / UM,
        "datum": network.precision.datum,
        "total_rms_sigma_um": None if total is None else _rms_um(total),
        "total_max_sigma_um": None if total is None else float(total.sigma.max()) / UM,
        "total_datum": None if total is None else total.datum,
        "bound_ratio": network.bound_ratio,
        "rays": network.precision.rays,
        "sigma_um": network.precision.sigma / UM,
        "total_sigma_um": None if total is None else total.sigma / UM,
        "warnings": list(network.warnings),
        "flagged": network.flagged,
    }


def _rms_um(precision: PointPrecision) -> float:
    return float(np.sqrt(precision.mean_variance)) / UM


def projection_record(camera: Camera) -> dict[str, Any]:
    """Return a camera's picture and projection with the keys of a study's [camera] table."""
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "focal_px": camera.focal_px,
        "principal_point_px": camera.principal_point_px,
        "distortion": camera.distortion,
    }


def _camera(task: Task) -> dict[str, Any]:
    camera = task.camera
    return {
        **projection_record(camera),
        "sigma_px": camera.sigma_px,
        "corner_noise": None
        if camera.corner_noise is None
        else {"k": camera.corner_noise.k, "floor_px": camera.corner_noise.floor_px},
    }
