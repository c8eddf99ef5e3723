"""The report of a run: RUN/report.html, one file that needs nothing else, and RUN/figures/*.png."""

from pathlib import Path
from typing import Any

import numpy as np

from netdesign.choose import choose, poses_of
from netdesign.errors import InfeasibleError
from netdesign.files.design_json import read_design, vias_of
from netdesign.files.store import read_json, write_bytes, write_text
from netdesign.files.study_text import study_toml
from netdesign.model.arrays import Bools, Floats
from netdesign.model.task import Task
from netdesign.motion.driven import leg_lengths
from netdesign.motion.joint_map import JointMap
from netdesign.motion.joint_tour import chain_law
from netdesign.motion.robot import Chain, load_chain
from netdesign.photogrammetry.limited_error import limited_covariance
from netdesign.photogrammetry.precision import sighting_sigma
from netdesign.photogrammetry.total_error import DATUM
from netdesign.photogrammetry.visibility import Sight
from netdesign.placement.distances import network_total_error
from netdesign.reporting import statics
from netdesign.reporting.arm import Arm
from netdesign.reporting.mesh import PartMesh
from netdesign.reporting.pages import Pictures, page
from netdesign.reporting.reach import Reach, reach_figure
from netdesign.reporting.record import NetworkRecord, RunRecord
from netdesign.reporting.statics import Raster, thumbnail
from netdesign.run_folder import open_run

MM, UM = 1e-3, 1e-6
TRIANGLES = 20000  # of the part as it is drawn
THUMBNAILS = 4  # of a network; the recommended one shows every station
REACH_SAMPLES = 4000
SCREEN_WIDTH, PAPER_DPI = 1100, 170  # px, dots per inch


def write_report(run: Path) -> Path:
    """Write RUN/report.html and RUN/figures/*.png from what the run holds so far; return the path of the page.

    Works after ``design`` alone; what has not been validated is said to be so. The same run gives the same bytes.

    Raises:
        InputError: ``run`` is not a run directory with a design, or a file in it is damaged.
    """
    record = read_run(run)
    mesh = PartMesh.of(record.task.scene.part, TRIANGLES)
    front = Raster.of(statics.front_figure(record), PAPER_DPI)
    write_bytes(run / "figures" / "front.png", front.png())
    networks = {}
    for network in record.networks:
        picture = Raster.of(statics.network_figure(record, network, mesh), PAPER_DPI)
        write_bytes(run / "figures" / f"network-{network.name}.png", picture.png())
        networks[network.id] = picture.webp(SCREEN_WIDTH)
    cell = statics.cell_figure(record, mesh)
    arm = None if cell is None else Raster.of(cell, PAPER_DPI)
    if arm is not None:
        write_bytes(run / "figures" / "cell.png", arm.png())
    reach = _reach(record, mesh)
    if reach is not None:
        write_bytes(run / "figures" / "reach.png", reach.png())
    achieved = statics.achieved_figure(record)
    proof = None if achieved is None else Raster.of(achieved, PAPER_DPI)
    if proof is not None:
        write_bytes(run / "figures" / "achieved.png", proof.png())
    pictures = Pictures(
        front=front.webp(SCREEN_WIDTH),
        networks=networks,
        cell=None if arm is None else arm.webp(SCREEN_WIDTH),
        reach=None if reach is None else reach.webp(SCREEN_WIDTH),
        achieved=None if proof is None else proof.webp(SCREEN_WIDTH * 2 // 3),
    )
    path = run / "report.html"
    write_text(path, page(record, mesh, pictures, study_toml(record.task.study)))
    return path


def _reach(record: RunRecord, mesh: PartMesh) -> Raster | None:
    """Return the picture of what the robot reaches; None without a robot."""
    task = record.task
    if task.cell is None:
        return None
    joint_map = JointMap.build(task.cell, task.sphere, task.scene.part)
    viewpoints = joint_map.lattice(samples=REACH_SAMPLES)
    reach = Reach(viewpoints=viewpoints, reasons=tuple(joint_map.reasons(viewpoints)))
    figure = reach_figure(record, mesh, reach)
    return None if figure is None else Raster.of(figure, PAPER_DPI)


def read_run(run: Path) -> RunRecord:
    """Return everything the report shows, the covariances recomputed from the poses and exact rays.

    Raises:
        InputError: ``run`` is not a run directory with a design, or a file in it is damaged.
    """
    task, design = open_run(run), read_design(run / "design.json")
    sight = Sight(task.scene, task.camera, task.limits)
    recommended, reason = _recommended(run)
    chain = None if task.cell is None else load_chain(task.cell)
    networks = tuple(_network(run, task, sight, entry, recommended, chain) for entry in design["networks"])
    return RunRecord(
        task=task,
        design=design,
        networks=networks,
        campaign=_optional(run / "validation.json", "validation"),
        knee=recommended,
        reason=reason,
        arm=None if task.cell is None or chain is None else Arm.of(task.cell, chain),
        recomputed=max(_difference(network) for network in networks),
    )


def _network(
    run: Path, task: Task, sight: Sight, entry: dict[str, Any], recommended: int, chain: Chain | None
) -> NetworkRecord:
    poses = poses_of(entry)
    seen = sight.look(poses)
    total = network_total_error(task, poses, seen.visible)
    folder = run / "networks" / f"{entry['id']:04d}"
    return NetworkRecord(
        planned=entry,
        world_from_cam=poses,
        visible_tags=seen.visible_tags,
        limited=total.limited,
        total=total.covariance,
        vias=vias_of(entry),
        legs=_legs(task, entry, poses, chain),
        without=_without(task, poses, seen.visible),
        datum=DATUM,
        determined=total.determined,
        diagnosis=total.diagnosis,
        validation=_optional(folder / "validation.json", "network-validation"),
        repeats=tuple(
            read_json(path, "network-validation") for path in sorted(folder.glob("repeat-*/validation.json"))
        ),
        thumbnails=_thumbnails(folder, everything=entry["id"] == recommended),
        adjustment=_optional(folder / "adjustment.json", "adjustment"),
    )


def _legs(task: Task, entry: dict[str, Any], poses: Floats, chain: Chain | None) -> Floats:
    """Return (n - 1,) lengths of the legs in the unit of f2: mm, weighted rad, or s of driving."""
    joints = entry.get("joints_rad")
    if task.study.motion == "workspace" or joints is None or task.cell is None or chain is None:
        straight: Floats = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / MM
        return straight
    law = chain_law(chain, np.array(task.cell.joint_weights or np.ones(len(chain))))
    return leg_lengths(np.array(joints), vias_of(entry), law, task.study.motion == "time")


def _without(task: Task, poses: Floats, visible: Bools) -> Floats:
    """Return (n,) the rms sigma in m, limited error propagation, of a network that loses one of its images."""
    points, intrinsics = task.scene.targets.points, task.camera.intrinsics
    sigma = sighting_sigma(task.camera, poses, task.scene.targets)
    found = []
    for image in range(len(poses)):
        seen = visible.copy()
        seen[image] = False
        covariance = limited_covariance(poses, points, intrinsics, seen, sigma)
        found.append(np.sqrt(np.trace(covariance, axis1=1, axis2=2).sum() / (3 * len(points))))
    return np.array(found)


def _thumbnails(folder: Path, everything: bool) -> tuple[tuple[str, bytes], ...]:
    """Return images of a network, all or a few spread over its tour, as small JPEGs; none before it is rendered."""
    paths = sorted((folder / "images").glob("*.png"))
    count = len(paths) if everything else min(len(paths), THUMBNAILS)
    chosen = sorted({round(index) for index in np.linspace(0, len(paths) - 1, count)})
    return tuple((f"station {index + 1}", thumbnail(paths[index])) for index in chosen)


def _recommended(run: Path) -> tuple[int, str]:
    """Return the network that ``choose`` would name, and why; the knee when the study's requirements cannot be met."""
    try:
        choice = choose(run)
    except InfeasibleError as error:
        choice = choose(run, knee=True)
        return choice.network, f"{choice.reason}. The requirements of the study are not met: {error}"
    return choice.network, choice.reason


def _difference(network: NetworkRecord) -> float:
    """Return the largest relative difference of a limited sigma between design.json and the report's own."""
    if network.planned.get("sigma_um") is None or "limited" not in str(network.planned.get("datum", "limited")):
        return 0.0
    written = np.array(network.planned["sigma_um"], dtype=np.float64)
    own = np.sqrt(np.diagonal(network.limited, axis1=1, axis2=2)) / UM
    return float(np.nanmax(np.abs(np.where(np.isfinite(own), written / own - 1.0, 0.0))))


def _optional(path: Path, kind: str) -> dict[str, Any] | None:
    return read_json(path, kind) if path.is_file() else None
