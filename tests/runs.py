"""Run directories for the tests: small, but every number in them is computed from real geometry.

The visibility is that of a convex part (incidence and frame), the covariance the sum over the rays of the analytic
Jacobians, the tour the length of the order given: an independent short way to what ``netdesign design`` writes.
"""

import numpy as np
import tomli_w
import trimesh

from netdesign.files.parts import TAG_COLUMNS
from netdesign.files.store import write_json
from netdesign.files.study import load_task
from netdesign.model.frames import look_at, sphere_directions
from netdesign.photogrammetry.collinearity import project_with_jacobians
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


def design_payload(task, candidates):
    """The content of design.json for networks given by their viewpoints, dominated ones removed."""
    points = task.scene.targets.points
    networks = []
    for viewpoints in candidates:
        poses = look_at(0.6 * sphere_directions(viewpoints), np.zeros(3))
        visible = convex_visible(task, poses)
        if visible.sum(axis=0).min() < task.limits.min_rays:
            continue
        covariance = limited(task, poses, visible)
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * 1e6
        tour = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() * 1e3
        poses[:, :3, 3] *= 1e3
        networks.append(
            {
                "objectives": [float((sigma**2).mean() * 1e-6), float(tour), len(poses)],
                "viewpoints_deg": np.degrees(viewpoints).tolist(), "world_from_cam_mm": poses.tolist(),
                "joints_rad": None, "rms_sigma_um": float(np.sqrt((sigma**2).mean())),
                "max_sigma_um": float(sigma.max()), "total_rms_sigma_um": None, "bound_ratio": None,
                "rays": visible.sum(axis=0).tolist(), "sigma_um": sigma.tolist(), "warnings": [],
            }
        )  # fmt: skip
    objectives = np.array([network["objectives"] for network in networks])
    dominated = [((objectives <= row).all(axis=1) & (objectives < row).any(axis=1)).any() for row in objectives]
    kept = [network for network, out in zip(networks, dominated, strict=True) if not out]
    kept.sort(key=lambda network: (network["objectives"][2], network["objectives"][0]))
    for index, network in enumerate(kept):
        network["id"] = index
    normals = task.scene.targets.point_normals
    return {
        "objectives": [
            {"name": "mean point variance", "unit": "mm^2"}, {"name": "tour (workspace)", "unit": "mm"},
            {"name": "images", "unit": "1"},
        ],
        "points": [
            {"id": name, "xyz_mm": (1e3 * xyz).tolist(), "normal": normal.tolist()}
            for name, xyz, normal in zip(task.scene.targets.point_ids, points, normals, strict=True)
        ],
        "camera": task.study.camera.model_dump(mode="json"),
        "history": {"evaluations": [len(candidates)], "hypervolume": [1.0]},
        "bounds": {},
        "notes": [],
        "networks": kept,
    }  # fmt: skip


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
    write_json(run / "design.json", "design", design_payload(task, candidates), task.sha256)
    return task
