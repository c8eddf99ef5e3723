"""The numbers that the interactive figures of the report draw, rounded to what a picture can show."""

import json
from typing import Any

import numpy as np

from netdesign.model.arrays import Floats
from netdesign.model.task import Task
from netdesign.reporting import palette
from netdesign.reporting.arm import Arm
from netdesign.reporting.mesh import PartMesh
from netdesign.reporting.proof import scatter
from netdesign.reporting.record import NetworkRecord, RunRecord
from netdesign.reporting.statics import exaggeration

MM, UM2 = 1e3, 1e12
UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))  # rows and columns of xx, xy, xz, yy, yz, zz


def payload(record: RunRecord, mesh: PartMesh) -> dict[str, Any]:
    """Return the data of the page; lengths in mm, sigmas in µm, covariances in µm² as xx, xy, xz, yy, yz, zz."""
    task = record.task
    camera, sphere = task.camera, task.sphere
    width, height = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    colors = palette.ordered(network.images for network in record.networks)
    return {
        "sigmaName": record.precision_name,
        "tourUnit": record.tour_unit,
        "knee": record.knee,
        "bounds": [[size, significant(value, 5)] for size, value in record.bounds_um()],
        "part": {
            "v": decimals(mesh.vertices * MM, 2),
            "f": mesh.faces.ravel().tolist(),
            "e": mesh.edges.ravel().tolist(),
        },
        "tags": decimals(_raised(task) * MM, 3),
        "points": decimals(task.scene.targets.points * MM, 3),
        "pointIds": list(task.scene.targets.point_ids),
        "frustum": decimals((corners - camera.principal_point_px) / camera.focal_px, 4),
        "radius": significant(sphere.radius * MM, 6),
        "arm": None if record.arm is None else _arm(record.arm),
        "networks": [_network(record, network, color) for network, color in zip(record.networks, colors, strict=True)],
    }


def _arm(arm: Arm) -> dict[str, Any]:
    """Return the robot: rows of 3x4 matrices with mm, meshes per link, boxes."""

    def matrices(poses: Floats) -> list[float]:
        scaled = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)[:, :3].copy()
        scaled[:, :, 3] *= MM
        return decimals(scaled, 5)

    return {
        "name": arm.name,
        "base": matrices(arm.world_from_base),
        "placements": matrices(arm.placements),
        "camera": matrices(arm.last_from_cam),
        "links": [
            {"link": mesh.link, "v": decimals(mesh.vertices * MM, 1), "f": mesh.faces.ravel().tolist()}
            for mesh in arm.links
        ],
        "obstacles": [decimals(box * MM, 2) for box in arm.obstacles],
    }


def as_script(content: dict[str, Any]) -> str:
    """Return JSON that may stand inside a script element."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False, ensure_ascii=False, sort_keys=True)
    return text.replace("<", "\\u003c")


def decimals(values: Floats, digits: int) -> list[float]:
    """Return the values in one flat list, rounded."""
    rounded: list[float] = (np.round(np.asarray(values, dtype=np.float64).ravel(), digits) + 0.0).tolist()
    return rounded


def significant(value: float, digits: int) -> float | None:
    """Return ``value`` with so many significant digits; None when it is not finite."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def _network(record: RunRecord, network: NetworkRecord, color: str) -> dict[str, Any]:
    poses = network.world_from_cam
    return {
        "id": network.id,
        "images": network.images,
        "sigma": significant(record.precision_um(network), 5),
        "tour": significant(network.tour, 6),
        "total": significant(network.total_rms_um, 4),
        "bound": None if network.bound_ratio is None else significant(network.bound_ratio, 4),
        "verdict": network.verdict,
        "color": color,
        "factor": exaggeration(record, network.total),
        "centres": decimals(poses[:, :3, 3] * MM, 2),
        "rotations": decimals(poses[:, :3, :3], 5),
        "seen": [np.flatnonzero(row).tolist() for row in network.visible_tags],
        "rays": network.rays.tolist(),
        "limited": _blocks(network.limited),
        "total_cov": _blocks(network.total),
        "joints": None if (joints := network.planned.get("joints_rad")) is None else decimals(np.array(joints), 5),
        "vias": {str(leg): decimals(points, 5) for leg, points in network.vias.items()},
        "error": _errors(network),
        "proof": scatter(network),
    }


def _raised(task: Task) -> Floats:
    """Return the tag corners lifted a little off the part, so that the two surfaces do not fight in the picture."""
    targets = task.scene.targets
    return targets.points + 0.06 * targets.size_m * targets.point_normals


def _blocks(covariance: Floats) -> list[float | None]:
    flat = (covariance[:, UPPER[0], UPPER[1]] * UM2).ravel()
    return [significant(value, 4) for value in flat.tolist()]


def _errors(network: NetworkRecord) -> list[float | None] | None:
    """Return the true errors of the adjusted points, µm, when the validation knows them."""
    errors = (network.validation or {}).get("errors_um")
    if errors is None:
        return None
    return [None if value is None else significant(float(value), 4) for row in errors for value in row["error_um"]]
