"""Projects as real users bring them, written as observation sets, and what a dense bordered adjustment says of them.

The kinds: an aerial block in national coordinates, a building with many two-ray points, a small part with scale bars,
a camera calibration field. Metres inside; the files are written here line by line, not by the product.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from netdesign.model.frames import exp_rotation, inverse, look_at
from netdesign.photogrammetry.collinearity import project, project_with_jacobians

MODELS = {
    "SIMPLE_PINHOLE": (0, 2, 3),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 2, 3, 4),
    "RADIAL": (0, 2, 3, 4, 5),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass
class Project:
    """Truth and image points; control (indices, coordinates, sigmas), bars (a, b, length, sigma) if any."""

    poses: np.ndarray
    points: np.ndarray
    intrinsics: np.ndarray
    image: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    covariance: np.ndarray
    camera_of_image: np.ndarray
    ids: np.ndarray
    names: list
    control: tuple | None = None
    bars: tuple | None = None
    models: list = field(default_factory=lambda: ["OPENCV"])
    camera_ids: list = field(default_factory=lambda: [1])


def observed(poses, points, intrinsics, visible, sigma=0.5, seed=0, camera_of_image=None, **more):
    """A Project with noisy image points of the given visibility."""
    rng = np.random.default_rng(seed)
    image, point = np.nonzero(visible)
    intrinsics = np.atleast_2d(intrinsics)
    of_image = np.zeros(len(poses), int) if camera_of_image is None else np.asarray(camera_of_image)
    xy, depth = project(poses[image], points[point], intrinsics[of_image[image]])
    assert (depth > 0).all()
    return Project(
        poses=poses,
        points=points,
        intrinsics=intrinsics,
        image=image,
        point=point,
        xy=xy + sigma * rng.standard_normal(xy.shape),
        covariance=np.tile(sigma**2 * np.eye(2), (len(image), 1, 1)),
        camera_of_image=of_image,
        ids=np.arange(len(points)) * 7 + 3,
        names=[f"img {i:03d}.jpg" for i in range(len(poses))],
        **more,
    )


def in_frame(poses, points, intrinsics, size, deepest=np.inf):
    """(n, m): which points lie in the picture, in front of the camera and not deeper than ``deepest``."""
    xy, depth = project(poses[:, None], points[None], intrinsics)
    return (depth > 0.05) & (depth < deepest) & (xy > 20).all(axis=-1) & (xy < np.asarray(size) - 20).all(axis=-1)


def thinned(visible, mean_rays, rng):
    """Drop sightings at random until points have about ``mean_rays``, never less than two; unseen points stay so."""
    keep = visible.copy()
    for j in range(visible.shape[1]):
        seen = np.flatnonzero(visible[:, j])
        wanted = min(len(seen), 2 + rng.geometric(1 / max(mean_rays - 1, 1.01)) - 1)
        keep[rng.permutation(seen)[wanted:], j] = False
    return keep


def aerial(images=5, count=80, sigma=0.3, seed=0, offset=(512_000.0, 5_340_000.0, 110.0), control=6):
    """A strip over hilly ground, flying height 800 m, in UTM coordinates; control of 2 to 8 cm."""
    rng = np.random.default_rng(seed)
    intrinsics = np.array([4500.0, 4500, 2000, 1500, -0.02, 0.01, 0, 0])
    strips = 1 if images <= 6 else int(np.ceil(images / 10))
    per = int(np.ceil(images / strips))
    x, y = np.meshgrid(260.0 * np.arange(per), 320.0 * np.arange(strips))
    centre = np.stack([x.ravel(), y.ravel(), np.full(x.size, 800.0)], 1)[:images] + rng.normal(0, 8, (images, 3))
    turn = Rotation.from_euler(
        "xyz", np.c_[np.full(images, 180.0), np.zeros((images, 2))] + rng.normal(0, 2, (images, 3)), degrees=True
    )
    poses = np.tile(np.eye(4), (images, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turn.as_matrix(), centre
    low, high = centre[:, :2].min(0) - 250, centre[:, :2].max(0) + 250
    points = np.c_[rng.uniform(low, high, (4 * count, 2)), rng.uniform(-30, 30, 4 * count)]
    visible = in_frame(poses, points, intrinsics, (4000, 3000))
    good = np.flatnonzero(visible.sum(0) >= 2)[:count]
    points, visible = points[good], visible[:, good]
    visible = visible & (rng.random(visible.shape) < 0.9)
    short = np.flatnonzero(visible.sum(0) < 2)
    visible[:, short] = in_frame(poses, points[short], intrinsics, (4000, 3000))
    poses[:, :3, 3] += offset
    points = points + offset
    made = observed(poses, points, intrinsics, visible, sigma, seed)
    spread = [int(np.argmin((points - points.mean(0)) @ rng.normal(size=3))) for _ in range(3 * control)]
    chosen = np.array(list(dict.fromkeys(spread))[:control])
    level = rng.uniform(0.02, 0.08, len(chosen))
    return replace(
        made, control=(chosen, points[chosen] + level[:, None] * rng.standard_normal((len(chosen), 3)), level)
    )


def building(images=40, count=1500, sigma=0.6, seed=0, mean_rays=3.0, offset=(0.0, 0, 0)):
    """Photographs around a building of 40 x 25 x 15 m: long tracks are rare, most points have two or three rays."""
    rng = np.random.default_rng(seed)
    intrinsics = np.array([3200.0, 3200, 1999.5, 1499.5, -0.1, 0.08, 5e-4, -4e-4])
    angle = np.arange(images) * 2 * np.pi / images
    eye = np.c_[38 * np.cos(angle), 30 * np.sin(angle), rng.uniform(1, 6, images)]
    aim = np.c_[rng.normal(0, 3, (images, 2)), np.full(images, 6.0)]
    rolls = rng.normal(0, 0.03, images) + np.pi / 2 * (rng.random(images) < 0.2)
    poses = np.stack([look_at(e[None], a, r)[0] for e, a, r in zip(eye, aim, rolls, strict=True)])
    face = rng.integers(0, 4, count)
    u, v = rng.uniform(-1, 1, count), rng.uniform(0, 15, count)
    x = np.select([face == 0, face == 1], [20.0, -20.0], 20 * u)
    y = np.select([face == 2, face == 3], [12.5, -12.5], 12.5 * u)
    points = np.c_[x, y, v] + rng.normal(0, 0.3, (count, 3))
    normal = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])[face]
    ray = poses[:, None, :3, 3] - points[None]
    facing = (ray * normal[None]).sum(-1) > 0.25 * np.linalg.norm(ray, axis=-1)
    visible = thinned(in_frame(poses, points, intrinsics, (4000, 3000)) & facing, mean_rays, rng)
    good = visible.sum(0) >= 2
    return observed(poses + _shift(offset), points[good] + offset, intrinsics, visible[:, good], sigma, seed)


def part(images=12, count=60, sigma=0.1, seed=0, size=0.2):
    """A small part with two scale bars, all around convergent."""
    rng = np.random.default_rng(seed)
    intrinsics = np.array([3600.0, 3590, 1223.5, 1023.5, -0.08, 0.12, 4e-4, -3e-4])
    points = rng.uniform(-0.5, 0.5, (count, 3)) * np.array([1, 0.8, 0.4]) * size
    alpha, beta = np.arange(images) * 2 * np.pi / images, np.radians(rng.uniform(35, 70, images))
    eye = 3.5 * size * np.c_[np.cos(alpha) * np.cos(beta), np.sin(alpha) * np.cos(beta), np.sin(beta)]
    poses = look_at(eye, np.zeros(3), rng.integers(0, 4, images) * np.pi / 2)
    visible = rng.random((images, count)) < 0.8
    visible[:3] = True
    made = observed(poses, points, intrinsics, visible, sigma, seed)
    a, b = np.array([0, 2]), np.array([1, 3])
    level = np.array([0.01e-3, 0.02e-3])
    length = np.linalg.norm(points[a] - points[b], axis=1) + level * rng.standard_normal(2)
    return replace(made, bars=(a, b, length, level))


def field_of_targets(images=20, sigma=0.15, seed=0, flat=True, distortion=(-0.25, 0.15, 1e-3, -8e-4)):
    """A camera calibration field of 100 targets, convergent, with rolls; distortion far from zero."""
    rng = np.random.default_rng(seed)
    intrinsics = np.array([2900.0, 2900, 1610, 1190, *distortion])
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 10), np.linspace(-0.5, 0.5, 10))
    points = np.c_[x.ravel(), y.ravel(), np.zeros(100) if flat else rng.uniform(0, 0.25, 100)]
    alpha, beta = np.arange(images) * 2.4, np.radians(rng.uniform(45, 85, images))
    eye = 1.35 * np.c_[np.cos(alpha) * np.cos(beta), np.sin(alpha) * np.cos(beta), np.sin(beta)]
    poses = look_at(eye, np.zeros(3), rng.integers(0, 4, images) * np.pi / 2 + rng.normal(0, 0.05, images))
    visible = in_frame(poses, points, intrinsics, (3200, 2400)) & (rng.random((images, 100)) < 0.97)
    made = observed(poses, points, intrinsics, visible, sigma, seed)
    corners = np.array([0, 9, 90, 99])
    return replace(made, control=(corners, points[corners], np.zeros(4)))


def _shift(offset):
    matrix = np.zeros((4, 4))
    matrix[:3, 3] = offset
    return matrix


def poor_start(project, seed=0, position=1.0, degrees=2.0, point=1.0, focal=1.0):
    """The project with approximate values off by Gaussian errors (m, degrees) and a factor on the focal length."""
    rng = np.random.default_rng(seed + 100)
    poses = project.poses.copy()
    poses[:, :3, 3] += position * rng.standard_normal((len(poses), 3))
    poses[:, :3, :3] = poses[:, :3, :3] @ exp_rotation(np.radians(degrees) * rng.standard_normal((len(poses), 3)))
    intrinsics = project.intrinsics.copy()
    intrinsics[:, :2] *= focal
    return replace(
        project,
        poses=poses,
        intrinsics=intrinsics,
        points=project.points + point * rng.standard_normal(project.points.shape),
    )


def write_project(folder, project, points2d=True, csv=False, covariances=True, line_end="\n", digits=17):
    """Write the observation set."""
    folder.mkdir(parents=True, exist_ok=True)

    def number(value):
        return f"{float(value):.{digits}g}"

    def put(name, lines):
        (folder / name).write_bytes((line_end.join(lines) + line_end).encode())

    lines = ["# Camera list"]
    for camera_id, model, row in zip(project.camera_ids, project.models, project.intrinsics, strict=True):
        values = row.copy()
        values[2:4] += 0.5
        lines.append(" ".join([str(camera_id), model, "4000", "3000", *(number(values[k]) for k in MODELS[model])]))
    put("cameras.txt", lines)
    lines = ["# Image list"]
    placed = inverse(project.poses)
    quaternion = Rotation.from_matrix(placed[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    for i, name in enumerate(project.names):
        pose = [*quaternion[i], *(placed[i, :3, 3] * 1e3)]
        camera_id = project.camera_ids[project.camera_of_image[i]]
        lines.append(" ".join([str(i + 11), *map(number, pose), str(camera_id), name]))
        rows = np.flatnonzero(project.image == i) if points2d else []
        lines.append(
            " ".join(
                f"{number(project.xy[k, 0] + 0.5)} {number(project.xy[k, 1] + 0.5)} {project.ids[project.point[k]]}"
                for k in rows
            )
        )
    put("images.txt", lines)
    lines = ["# points"]
    for number_of, xyz in zip(project.ids, project.points, strict=True):
        lines.append(" ".join([str(number_of), *map(number, xyz * 1e3), "0 0 0 0"]))
    put("points3D.txt", lines)
    if csv:
        head = "image,point,x_px,y_px" + (",sxx_px2,sxy_px2,syy_px2" if covariances else "")
        lines = [head]
        for i, j, xy, c in zip(project.image, project.point, project.xy, project.covariance, strict=True):
            values = [*xy, c[0, 0], c[0, 1], c[1, 1]] if covariances else xy
            lines.append(",".join([project.names[i], str(project.ids[j]), *map(number, values)]))
        put("observations.csv", lines)
    if project.control is not None:
        by_axis = np.ndim(project.control[2]) == 2
        lines = ["point,x_mm,y_mm,z_mm," + ("sx_mm,sy_mm,sz_mm" if by_axis else "sigma_mm")]
        for j, xyz, sigma in zip(*project.control, strict=True):
            values = np.r_[xyz * 1e3, np.atleast_1d(sigma) * 1e3]
            if by_axis:  # what is not known stays empty
                values[np.isinf(np.r_[sigma, sigma])] = np.nan
            lines.append(",".join([str(project.ids[j]), *("" if np.isnan(v) else number(v) for v in values)]))
        put("control.csv", lines)
    if project.bars is not None:
        lines = ["a,b,length_mm,sigma_mm"]
        for a, b, length, sigma in zip(*project.bars, strict=True):
            lines.append(f"{project.ids[a]},{project.ids[b]},{number(length * 1e3)},{number(sigma * 1e3)}")
        put("scalebars.csv", lines)


def dense_sigmas(project, record, datum, refine=(), datum_points=None, priors=None):
    """Sigmas a priori of points (m, 3), projection centres (n, 3) in mm, and interior parameters, at the estimates.

    One dense normal matrix of everything, bordered by the datum; lengths in units of the object's extent. ``priors``:
    sigma of all positions (m) and rotations (rad).
    """
    order = {name: i for i, name in enumerate(project.names)}
    rows = {row["name"]: row for row in record["images"]}
    poses = np.array([rows[name]["world_from_cam_mm"] for name in order])
    by_id = {row["id"]: row for row in record["points"]}
    points = np.array([by_id[str(i)]["xyz_mm"] for i in project.ids], dtype=float)
    centre = points.mean(axis=0)
    unit = np.sqrt(((points - centre) ** 2).sum(1).mean())
    points = (points - centre) / unit
    poses[:, :3, 3] = (poses[:, :3, 3] - centre) / unit
    cameras = record["intrinsics"].get("cameras", [record["intrinsics"]])
    intrinsics = np.array([[camera["values"][name] for name in NAMES] for camera in cameras])
    n, m, q = len(poses), len(points), len(refine)
    p = q * len(intrinsics)
    design = np.zeros((2 * len(project.image), 6 * n + p + 3 * m))
    whiten = np.linalg.inv(np.linalg.cholesky(project.covariance))
    camera = project.camera_of_image[project.image]
    projection = project_with_jacobians(poses[project.image], points[project.point], intrinsics[camera])
    for k, (i, j, c) in enumerate(zip(project.image, project.point, camera, strict=True)):
        at = slice(2 * k, 2 * k + 2)
        design[at, 6 * i : 6 * i + 6] = whiten[k] @ projection.d_xy_d_pose[k]
        design[at, 6 * n + p + 3 * j : 6 * n + p + 3 * j + 3] = whiten[k] @ projection.d_xy_d_point[k]
        for column, name in enumerate(refine):
            derivative = projection.d_xy_d_intrinsics[k]
            if name == "f":
                value = derivative[:, 0] + derivative[:, 1] * intrinsics[c, 1] / intrinsics[c, 0]
            else:
                value = derivative[:, NAMES.index(name)]
            design[at, 6 * n + c * q + column] = whiten[k] @ value
    first = 6 * n + p
    extra = []
    fixed = np.zeros(m, bool)
    if priors is not None:
        block = np.zeros((6 * n, design.shape[1]))
        block[range(6 * n), range(6 * n)] = np.tile(
            1 / np.r_[np.full(3, priors[1]), np.full(3, priors[0] * 1e3 / unit)], n
        )
        extra.append(block)
    if datum in ("control", "fixed") and project.control is not None:
        for j, _, sigma in zip(*project.control, strict=True):
            if np.all(sigma == 0) or datum == "fixed":
                fixed[j] = True
                continue
            block = np.zeros((3, design.shape[1]))
            block[:, first + 3 * j : first + 3 * j + 3] = np.eye(3) * unit / (sigma * 1e3)
            extra.append(block)
    if datum != "free" and project.bars is not None:
        for a, b, _, sigma in zip(*project.bars, strict=True):
            direction = (points[a] - points[b]) / np.linalg.norm(points[a] - points[b])
            block = np.zeros((1, design.shape[1]))
            block[0, first + 3 * a : first + 3 * a + 3] = direction * unit / (sigma * 1e3)
            block[0, first + 3 * b : first + 3 * b + 3] = -direction * unit / (sigma * 1e3)
            extra.append(block)
    design = np.vstack([design, *extra])
    free = np.r_[np.ones(first, bool), np.repeat(~fixed, 3)]
    design = design[:, free]
    borders = np.zeros((len(free), {"free": 7, "scale": 6}.get(datum, 0)))
    chosen = np.ones(m) if datum_points is None else np.isin(project.ids.astype(str), datum_points)
    for j in range(m):
        x, y, z = points[j]
        g = np.array([[1, 0, 0, 0, z, -y, x], [0, 1, 0, -z, 0, x, y], [0, 0, 1, y, -x, 0, z]]) * chosen[j]
        borders[first + 3 * j : first + 3 * j + 3] = g[:, : borders.shape[1]]
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = _bordered(design, borders[free])
    position = np.zeros((n, 3))
    for i in range(n):
        block = covariance[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6]
        position[i] = np.sqrt(np.diag(poses[i, :3, :3] @ block @ poses[i, :3, :3].T)) * unit
    diagonal = np.sqrt(np.maximum(np.diag(covariance), 0))
    return diagonal[first:].reshape(m, 3) * unit, position, diagonal[6 * n : first], covariance


def _bordered(design, borders):
    """Inverse of the bordered normal equations, Jacobi-scaled, one step of refinement."""
    normal = design.T @ design
    scale = 1 / np.sqrt(np.diag(normal))
    u, d = len(scale), borders.shape[1]
    g = borders * scale[:, None]
    g = g / np.linalg.norm(g, axis=0) if d else g
    full = np.zeros((u + d, u + d))
    full[:u, :u] = normal * scale[:, None] * scale[None, :]
    full[:u, u:], full[u:, :u] = g, g.T
    found = np.linalg.inv(full)
    found = found @ (2 * np.eye(u + d) - full @ found)
    return found[:u, :u] * scale[:, None] * scale[None, :]


def disagreement(project, record, datum, refine=(), datum_points=None):
    """Largest relative difference of every published sigma from the dense solution: points, stations, parameters."""
    points, position, parameters, _ = dense_sigmas(project, record, datum, refine, datum_points)
    by_id = {row["id"]: row for row in record["points"]}
    rows = {row["name"]: row for row in record["images"]}
    found_points = np.array([by_id[str(i)]["sigma_apriori_mm"] for i in project.ids])
    found_position = np.array([rows[name]["sigma_position_apriori_mm"] for name in project.names])
    cameras = record["intrinsics"].get("cameras", [record["intrinsics"]])
    found = np.array([camera["sigma"][name] for camera in cameras for name in refine]) / record["sigma0"]
    known = points > 0
    assert (found_points[~known] == 0).all()
    parts = [
        np.abs(found_points[known] / points[known] - 1).max(),
        np.abs(found_position / position - 1).max(),
        np.abs(found / parameters - 1).max(initial=0.0),
    ]
    return [float(value) for value in parts]
