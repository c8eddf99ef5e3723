"""Run directories for the tests: small, but every number in them is computed from real geometry.

The visibility is that of a convex part (incidence and frame), the covariance the sum over the rays of the analytic
Jacobians, the tour the length of the order given: an independent short way to what ``netdesign design`` writes.
"""

import numpy as np
import tomli_w
import trimesh

from netdesign.adjustment.bundle import adjust
from netdesign.adjustment.campaign import pool
from netdesign.adjustment.compare import compare
from netdesign.files.adjustment import adjustment_payload, campaign_member, campaign_payload, validation_payload
from netdesign.files.design_json import read_networks, write_design
from netdesign.files.parts import TAG_COLUMNS
from netdesign.files.store import read_json, write_json
from netdesign.files.study import load_task
from netdesign.model.frames import exp_rotation, look_at, pose, sphere_directions
from netdesign.model.network import Observations
from netdesign.model.results import Design, DesignedNetwork, PointPrecision, SearchHistory, Tour
from netdesign.photogrammetry.collinearity import project, project_with_jacobians
from netdesign.photogrammetry.total_error import total_covariance
from tests.scenes import CAMERA, box_scene

STUDY = {
    "format": 1,
    "name": "box-workspace",
    "seed": 7,
    "part": {"mesh": "inputs/part.stl"},
    "targets": {"size_mm": 20.0, "file": "inputs/targets.csv"},
    "camera": {
        "width_px": CAMERA.width_px, "height_px": CAMERA.height_px, "focal_px": CAMERA.focal_px.tolist(),
        "principal_point_px": CAMERA.principal_point_px.tolist(), "sigma_px": 0.1,
    },
    "viewpoints": {"radius_mm": 600, "max_images": 14},
    "visibility": {"max_incidence_deg": 75},
}  # fmt: skip


def write_inputs(run, scene, study):
    """Write study.toml, the mesh and the tag list of a scene below ``run``; return the task read back from there."""
    (run / "inputs").mkdir(parents=True)
    trimesh.Trimesh(scene.part.vertices * 1e3, scene.part.faces, process=False).export(run / "inputs/part.stl")
    targets = scene.targets
    rows = np.hstack([targets.ids[:, None], targets.centres * 1e3, targets.normals, targets.x_axes])
    lines = [",".join(TAG_COLUMNS)]
    lines += [",".join([str(int(row[0])), *map(repr, row[1:])]) for row in rows.tolist()]
    (run / "inputs/targets.csv").write_text("\n".join(lines) + "\n")
    (run / "study.toml").write_text(tomli_w.dumps(study))
    return load_task(run / "study.toml")


def convex_visible(task, world_from_cam):
    """(n, m) for a convex part: every corner of the tag within the incidence limit and inside the frame."""
    targets = task.scene.targets
    to_camera = world_from_cam[:, None, :3, 3] - targets.points
    cosine = (to_camera * targets.point_normals).sum(-1) / np.linalg.norm(to_camera, axis=-1)
    image = project_with_jacobians(world_from_cam[:, None], targets.points, task.camera.intrinsics)
    size = np.array([task.camera.width_px, task.camera.height_px])
    border = task.limits.border_px - 0.5
    inside = ((image.xy_px > border) & (image.xy_px < size - 1 - border)).all(-1) & (image.depth > 0)
    seen = (cosine >= np.cos(task.limits.max_incidence)) & inside
    return np.repeat(seen.reshape(len(seen), -1, 4).all(-1), 4, axis=1)


def limited(task, world_from_cam, visible):
    """(m, 3, 3) m²: inverse of the summed normal equations of every point's own rays."""
    jacobian = project_with_jacobians(
        world_from_cam[:, None], task.scene.targets.points, task.camera.intrinsics
    ).d_xy_d_point
    normal = np.einsum("nmij,nmik,nm->mjk", jacobian, jacobian, visible / task.camera.sigma_px**2)
    return np.linalg.inv(normal)


def ring_viewpoints(count, elevation, top):
    """``count`` stations on a ring, the last one moved to the top when asked."""
    alpha = np.arange(count) * 2 * np.pi / count + 0.1
    viewpoints = np.stack([np.arctan2(np.sin(alpha), np.cos(alpha)), np.full(count, np.radians(elevation))], axis=1)
    if top:
        viewpoints[-1] = (0.0, np.radians(89))
    return viewpoints


def front_of(task, candidates):
    """Return the Design of networks given by their viewpoints, inadmissible and dominated ones removed."""
    points, networks = task.scene.targets.points, []
    for viewpoints in candidates:
        poses = look_at(0.6 * sphere_directions(viewpoints), np.zeros(3))
        visible = convex_visible(task, poses)
        if visible.sum(axis=0).min() < task.limits.min_rays:
            continue
        precision = PointPrecision(
            covariance=limited(task, poses, visible),
            rays=visible.sum(axis=0),
            propagation="limited",
            datum="poses error-free (limited error propagation)",
        )
        total = total_covariance(poses, points, task.camera.intrinsics, visible, task.camera.sigma_px)
        length = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
        # No network sees a point under better geometry than n rays from the nearest admissible distance.
        nearest = 0.6 - np.linalg.norm(points, axis=1).max()
        bound = 1.5 * (task.camera.sigma_px * nearest / task.camera.focal_px[0]) ** 2 / len(poses)
        networks.append(
            DesignedNetwork(
                viewpoints=viewpoints,
                world_from_cam=poses,
                f1=precision.mean_variance,
                f2=length,
                f3=len(poses),
                tour=Tour(order=np.arange(len(poses)), length=length, space="workspace"),
                precision=precision,
                total=total.precision,
                bound_ratio=precision.mean_variance / bound,
                warnings=total.diagnosis,
            )
        )
    objectives = np.array([[network.f1, network.f2, network.f3] for network in networks])
    kept = [
        network
        for network, row in zip(networks, objectives, strict=True)
        if not ((objectives <= row).all(axis=1) & (objectives < row).any(axis=1)).any()
    ]
    kept.sort(key=lambda network: (network.f3, network.f1))
    return Design(
        networks=tuple(kept),
        history=SearchHistory(evaluations=[len(candidates)], hypervolume=[1.0]),
        bounds={network.f3: network.f1 / network.bound_ratio for network in kept},
    )


def ring_run(run, requirements=None, sizes=range(7, 14)):
    """Write a run directory with study, inputs and design.json for a box seen from rings; return the task."""
    study = STUDY if requirements is None else {**STUDY, "requirements": requirements}
    task = write_inputs(run, box_scene(spacing=0.06), study)
    candidates = [
        ring_viewpoints(count, elevation, top)
        for count in sizes
        for elevation in (26, 32, 38, 44, 50)
        for top in (False, True)
    ]
    write_design(run / "design.json", task, front_of(task, candidates))
    return task


def prove(run, task, networks=None, noise=1.0):
    """Adjust simulated image points of networks of a run with GTSAM and write what ``validate`` would.

    The true noise is ``noise`` times the predicted one. The poses are executed with 1 mm and 5 mrad of error.
    """
    points, ids = task.scene.targets.points, task.scene.targets.point_ids
    for network in read_networks(run).values():
        if networks is not None and network.id not in networks:
            continue
        random = np.random.default_rng([3, network.id])
        count = len(network.world_from_cam)
        error = pose(
            exp_rotation(random.normal(scale=5e-3, size=(count, 3))), random.normal(scale=1e-3, size=(count, 3))
        )
        poses = network.world_from_cam @ error
        image, point = np.nonzero(convex_visible(task, poses))
        sigma = task.camera.sigma_px
        xy, _ = project(poses[image], points[point], task.camera.intrinsics)
        observations = Observations(
            image=image, point=point, xy_px=xy + random.normal(scale=noise * sigma, size=xy.shape),
            covariance=np.tile(sigma**2 * np.eye(2), (len(image), 1, 1)),
        )  # fmt: skip
        adjustment = adjust(observations, task.camera, network.world_from_cam, points)
        visible = convex_visible(task, network.world_from_cam)
        total = total_covariance(network.world_from_cam, points, task.camera.intrinsics, visible, sigma)
        limited_precision = PointPrecision(
            covariance=total.limited, rays=total.rays, propagation="limited", datum="poses error-free"
        )
        validation = compare(points, adjustment, limited_precision, total.precision)
        record = validation_payload(validation, ids)
        record |= {"network": network.id, "repeat": 0, "verdict": "pass" if validation.passed else "fail"}
        folder = run / "networks" / f"{network.id:04d}"
        names = [f"{index:04d}.png" for index in range(count)]
        payload = adjustment_payload(adjustment, names, ids)
        write_json(folder / "adjustment.json", "adjustment", payload, task.sha256)
        write_json(folder / "validation.json", "network-validation", record, task.sha256)


def fail(run, task, network, reason):
    """Write the validation of a network that could not be adjusted."""
    record = {
        "network": network,
        "repeat": 0,
        "verdict": "failed",
        "passed": False,
        "reasons": [reason],
        "warnings": [],
    }
    write_json(run / f"networks/{network:04d}/validation.json", "network-validation", record, task.sha256)


def pool_run(run, task):
    """Write RUN/validation.json from the networks that were adjusted."""
    paths = sorted((run / "networks").glob("*/validation.json"))
    records = [read_json(path, "network-validation") for path in paths]
    members = [campaign_member(f"{item['network']:04d}", item) for item in records if item["verdict"] != "failed"]
    write_json(run / "validation.json", "validation", campaign_payload(pool(members)), task.sha256)
