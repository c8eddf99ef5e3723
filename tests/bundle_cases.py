"""Networks for the tests of the adjustment, and a dense reference that shares no algebra with the product."""

import numpy as np

from netdesign.adjustment.problem import BundleProblem
from netdesign.model.camera import Camera
from netdesign.model.frames import exp_rotation, look_at, sphere_directions
from netdesign.model.network import Observations
from netdesign.photogrammetry.collinearity import project, project_with_jacobians

INTRINSICS = np.array([3600.0, 3590.0, 1223.5, 1023.5, -0.08, 0.12, 4e-4, -3e-4])


def relief(images, points, seed=0, radius=1.0, elevation=(30, 75), roll=True):
    """Cameras on a cone-ish hemisphere about a relief of points that every image sees; (poses, points)."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-0.2, -0.15, -0.075], [0.2, 0.15, 0.075], (points, 3))
    alpha = np.arange(images) * 2 * np.pi / images + rng.uniform(0, 0.4, images)
    beta = np.radians(rng.uniform(*elevation, images))
    roll_angle = rng.integers(0, 4, images) * np.pi / 2 if roll else 0.0
    poses = look_at(radius * sphere_directions(np.stack([alpha, beta], axis=1)), np.zeros(3), roll_angle)
    return poses, xyz


def random_visibility(images, points, share=0.75, seed=0, least=3):
    """A visibility table in which every point is seen at least ``least`` times."""
    rng = np.random.default_rng(seed)
    visible = rng.random((images, points)) < share
    for j in range(points):
        missing = least - visible[:, j].sum()
        if missing > 0:
            visible[rng.permutation(np.flatnonzero(~visible[:, j]))[:missing], j] = True
    return visible


def observe(poses, points, visible, sigma=0.1, seed=0, intrinsics=INTRINSICS, noise=True):
    """Noisy image points of a network as Observations."""
    rng = np.random.default_rng(seed)
    image, point = np.nonzero(visible)
    xy, _ = project(poses[image], points[point], intrinsics)
    if noise:
        xy = xy + sigma * rng.standard_normal(xy.shape)
    return Observations(
        image=image, point=point, xy_px=xy, covariance=np.tile(sigma**2 * np.eye(2), (len(image), 1, 1))
    )


def dense_design(poses, points, observations, intrinsics=INTRINSICS, matrix=None):
    """The whitened design matrix (2k, 6n + p + 3m), images first, and the residuals (2k,)."""
    image, point = observations.image, observations.point
    matrix = np.zeros((8, 0)) if matrix is None else matrix
    projection = project_with_jacobians(poses[image], points[point], intrinsics)
    whiten = np.linalg.inv(np.linalg.cholesky(observations.covariance))
    count, n, p = len(image), len(poses), matrix.shape[1]
    design = np.zeros((count, 2, 6 * n + p + 3 * len(points)))
    for k in range(count):
        design[k, :, 6 * image[k] : 6 * image[k] + 6] = whiten[k] @ projection.d_xy_d_pose[k]
        design[k, :, 6 * n : 6 * n + p] = whiten[k] @ projection.d_xy_d_intrinsics[k] @ matrix
        start = 6 * n + p + 3 * point[k]
        design[k, :, start : start + 3] = whiten[k] @ projection.d_xy_d_point[k]
    residual = np.einsum("kij,kj->ki", whiten, observations.xy_px - projection.xy_px)
    return design.reshape(2 * count, -1), residual.ravel()


def bordered_covariance(design, borders):
    """Covariance of all unknowns from the normal equations bordered by ``borders`` (u, d), Jacobi-scaled."""
    normal = design.T @ design
    scale = 1.0 / np.sqrt(np.diag(normal))
    g = borders * scale[:, None]
    g = g / np.linalg.norm(g, axis=0)
    u, d = g.shape
    full = np.zeros((u + d, u + d))
    full[:u, :u] = normal * scale[:, None] * scale[None, :]
    full[:u, u:], full[u:, :u] = g, g.T
    return (np.linalg.inv(full)[:u, :u]) * scale[:, None] * scale[None, :]


def relative(a, b):
    """Relative Frobenius distance of b from a."""
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def camera_of(intrinsics=INTRINSICS):
    """The Camera with the given intrinsics (8,)."""
    return Camera(
        width_px=2448,
        height_px=2048,
        focal_px=intrinsics[:2],
        principal_point_px=intrinsics[2:4],
        distortion=intrinsics[4:],
    )


def disturbed(poses, points, seed=0, position=0.003, rotation=0.003, point=0.001):
    """Approximate values: poses and points with Gaussian errors (m, rad)."""
    rng = np.random.default_rng(seed)
    start = poses.copy()
    start[:, :3, 3] += position * rng.standard_normal((len(poses), 3))
    start[:, :3, :3] = start[:, :3, :3] @ exp_rotation(rotation * rng.standard_normal((len(poses), 3)))
    return start, points + point * rng.standard_normal(points.shape)


def problem_of(observations, poses, points, intrinsics=INTRINSICS, **options):
    """A BundleProblem of one camera with names i0, i1, … and p0, p1, …"""
    return BundleProblem(
        observations=observations,
        camera_of_image=np.zeros(len(poses), dtype=np.int64),
        intrinsics=np.atleast_2d(intrinsics),
        world_from_cam=poses,
        points=points,
        image_names=[f"i{i}" for i in range(len(poses))],
        point_names=[f"p{j}" for j in range(len(points))],
        **options,
    )
