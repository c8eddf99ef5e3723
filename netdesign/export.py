"""The export verb: one network of a run for other programs."""

from pathlib import Path
from typing import Literal

import numpy as np

from netdesign.errors import InputError
from netdesign.files.colmap import ColmapModel, point3d_id, write_model
from netdesign.files.design_json import PlannedNetwork, find_network
from netdesign.files.robot_program import (
    cell_glb,
    joint_trajectory_yaml,
    program_record,
    stations_csv,
    urscript,
)
from netdesign.files.store import write_bytes, write_json, write_text
from netdesign.model.task import Task
from netdesign.motion.program import PART_COLOUR, Solid
from netdesign.photogrammetry.collinearity import project
from netdesign.photogrammetry.visibility import sightings
from netdesign.run_folder import open_run

Format = Literal["json", "csv", "colmap", "urscript", "ros2", "glb"]


def export(run: Path, network_id: int, format: Format, out: Path) -> Path:
    """Write one network of a run directory and return where.

    Args:
        format: json, csv: stations, joints, via points; colmap: a text model with predicted observations (a folder);
            urscript, ros2: a program that drives the tour; glb: the cell with the arm at the first station, of a study
            without a robot the part and the stations.

    Raises:
        InputError: no such run or network; a robot program of a study without a robot.
        InfeasibleError: a leg without a free way.
    """
    task = open_run(run)
    network = find_network(run, network_id)
    if format == "colmap" and out.is_file():
        raise InputError(f"{out}: expected a folder for colmap, found a file")
    if format != "colmap" and out.is_dir():
        raise InputError(f"{out}: expected a file for {format}, found a folder")
    if format == "colmap":
        write_model(out, _colmap(task, network))
    elif task.cell is None or network.joints is None:
        _without_robot(task, network, format, out)
    else:
        _with_robot(task, network, format, out)
    return out


def _without_robot(task: Task, network: PlannedNetwork, format: Format, out: Path) -> None:
    if format == "csv":
        write_text(out, stations_csv(network.viewpoints, network.world_from_cam, None, ()))
    elif format == "json":
        write_json(out, "program", {"study": task.study.name, "stations": _stations(network)}, task.sha256)
    elif format == "glb":
        part = task.scene.part
        solid = Solid(name="part", vertices=part.vertices, faces=part.faces, colour=PART_COLOUR)
        write_bytes(out, cell_glb((solid,), network.world_from_cam, _half_field(task)))
    else:
        raise InputError(f"--format {format}: expected a study with a [robot] table, found none in {task.study.name}")


def _with_robot(task: Task, network: PlannedNetwork, format: Format, out: Path) -> None:
    # The kinematics compile on first use: only where they are needed.
    from netdesign.motion.joint_map import JointMap
    from netdesign.motion.program import cell_geometry, program_of, sampled

    if task.cell is None or network.joints is None:
        raise ValueError("expected a network with a robot")
    joint_map = JointMap.build(task.cell, task.sphere, task.scene.part)
    chain = joint_map.arm.chain
    if format == "csv":
        names = chain.joint_names
        write_text(out, stations_csv(network.viewpoints, network.world_from_cam, network.joints, names, network.vias))
        return
    if format == "glb":
        solids = cell_geometry(joint_map.arm, task.scene.part, network.joints[0])
        write_bytes(out, cell_glb(solids, network.world_from_cam, _half_field(task)))
        return
    program = program_of(joint_map, network.joints, network.vias)
    if format == "json":
        record = {**program_record(program, task), "stations": _stations(network)}
        write_json(out, "program", record, task.sha256)
    elif format == "urscript":
        write_text(out, urscript(program, network.id))
    else:
        write_text(out, joint_trajectory_yaml(program, sampled(program)))


def _half_field(task: Task) -> tuple[float, float]:
    """Half the width and height of the image at unit depth."""
    width, height = 0.5 * np.array([task.camera.width_px, task.camera.height_px]) / task.camera.focal_px
    return float(width), float(height)


def _stations(network: PlannedNetwork) -> list[dict[str, object]]:
    poses_mm = network.world_from_cam.copy()
    poses_mm[:, :3, 3] *= 1e3
    return [
        {"viewpoint_deg": np.degrees(viewpoint), "world_from_cam_mm": matrix}
        for viewpoint, matrix in zip(network.viewpoints, poses_mm, strict=True)
    ]


def _colmap(task: Task, network: PlannedNetwork) -> ColmapModel:
    """Return the network as a model: nominal poses, object points, and where each is predicted to appear."""
    targets = task.scene.targets
    visible = sightings(task.scene, task.camera, network.world_from_cam, task.limits).visible
    xy_px, _ = project(network.world_from_cam[:, None], targets.points, task.camera.intrinsics)
    image, point = np.nonzero(visible)
    return ColmapModel(
        cameras=(task.camera,),
        camera_ids=(1,),
        camera_of_image=np.zeros(len(network.viewpoints), dtype=np.int64),
        names=tuple(f"{index:04d}.png" for index in range(len(network.viewpoints))),
        world_from_cam=network.world_from_cam,
        point_ids=tuple(point3d_id(tag, corner) for tag in targets.ids.tolist() for corner in range(4)),
        points=targets.points,
        image=image,
        point=point,
        xy_px=xy_px[visible],
    )
