"""Poses as plain (…, 4, 4) float64 arrays; names cancel: world_from_cam @ cam_from_flange = world_from_flange.

Camera axes: x right, y down, z forward (OpenCV). Metres and radians.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from netdesign.model.arrays import Floats


def pose(rotation: Floats, translation: Floats) -> Floats:
    """Return a_from_b (…, 4, 4) with the given rotation (…, 3, 3) and origin of b in a (…, 3)."""
    a_from_b = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    a_from_b[..., :3, :3] = rotation
    a_from_b[..., :3, 3] = translation
    a_from_b[..., 3, 3] = 1.0
    return a_from_b


def inverse(a_from_b: Floats) -> Floats:
    """Return b_from_a (…, 4, 4) of rigid transforms, exactly orthogonal where the input is."""
    transposed = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return pose(transposed, -np.einsum("...ij,...j->...i", transposed, a_from_b[..., :3, 3]))


def transform(a_from_b: Floats, points: Floats) -> Floats:
    """Return points (…, 3) of frame b expressed in frame a."""
    rotated: Floats = np.einsum("...ij,...j->...i", a_from_b[..., :3, :3], points)
    return rotated + a_from_b[..., :3, 3]


def rotation_from_rpy(roll_pitch_yaw: Floats) -> Floats:
    """Return the rotation (3, 3) of URDF's roll, pitch, yaw in rad: Rz(yaw) Ry(pitch) Rx(roll)."""
    return np.asarray(Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix())


def quaternion_xyzw(rotation: Floats) -> Floats:
    """Return quaternions (…, 4), x y z w with w >= 0, of rotations (…, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def rotation_from_quaternion(quaternion: Floats) -> Floats:
    """Return the rotations (…, 3, 3) of quaternions (…, 4), x y z w, of any length but zero."""
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def skew(vectors: Floats) -> Floats:
    """Return the cross-product matrices (…, 3, 3) of vectors (…, 3): skew(a) @ b = a x b."""
    matrix = np.zeros((*vectors.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vectors[..., 2], vectors[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vectors[..., 2], -vectors[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vectors[..., 1], vectors[..., 0]
    return matrix


def exp_rotation(omega: Floats) -> Floats:
    """Return the rotations (…, 3, 3) of rotation vectors (…, 3) in rad."""
    flat = Rotation.from_rotvec(omega.reshape(-1, 3)).as_matrix()
    return np.asarray(flat.reshape(*omega.shape[:-1], 3, 3))


def sphere_directions(viewpoints: Floats) -> Floats:
    """Return unit vectors (…, 3) from the sphere's centre for viewpoints (…, 2) = (alpha, beta).

    Alpha is the azimuth about world z, beta the elevation above the world xy plane, both in rad.
    """
    alpha, beta = viewpoints[..., 0], viewpoints[..., 1]
    return np.stack([np.cos(beta) * np.cos(alpha), np.cos(beta) * np.sin(alpha), np.sin(beta)], axis=-1)


def viewpoints_of(directions: Floats) -> Floats:
    """Return (alpha, beta) in rad (…, 2) of directions (…, 3) of any length; alpha in (-pi, pi]."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)


def look_at(position: Floats, target: Floats, roll: Floats | float = 0.0) -> Floats:
    """Return world_from_cam (…, 4, 4) of cameras at ``position`` (…, 3) that look at ``target`` (…, 3).

    Roll 0 is the top view (x along world x) carried to the viewing direction by the smallest rotation
    (parallel transport): smooth everywhere but straight from below, where "up" is not. A positive roll (rad,
    scalar or (…,)) turns the camera about its own z axis, from x towards y. A camera at its target looks straight down.
    """
    outward = np.asarray(position, dtype=np.float64) - target
    distance = np.linalg.norm(outward, axis=-1, keepdims=True)
    outward = np.where(distance > 0.0, outward / np.where(distance > 0.0, distance, 1.0), [0.0, 0.0, 1.0])
    ux, uy, uz = outward[..., 0], outward[..., 1], outward[..., 2]
    # Columns of the smallest rotation that takes +z to `outward`; 1/(1+uz) is guarded at the nadir.
    scale = 1.0 / np.maximum(1.0 + uz, 1e-12)
    x_axis = np.stack([1.0 - ux * ux * scale, -ux * uy * scale, -ux], axis=-1)
    y_axis = -np.stack([-ux * uy * scale, 1.0 - uy * uy * scale, -uy], axis=-1)
    cos, sin = np.cos(roll), np.sin(roll)
    cos, sin = np.asarray(cos)[..., None], np.asarray(sin)[..., None]
    rotation = np.stack([cos * x_axis + sin * y_axis, cos * y_axis - sin * x_axis, -outward], axis=-1)
    return pose(rotation, np.asarray(position, dtype=np.float64))


def similarity(source: Floats, target: Floats, with_scale: bool = True) -> tuple[float, Floats, Floats]:
    """Return (scale, rotation (3, 3), translation (3,)) minimising |target - (s R source + t)|² over points (m, 3).

    Source: S. Umeyama, IEEE PAMI 13(4), 1991.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred_source, centred_target = source - mean_source, target - mean_target
    left, singular, right = np.linalg.svd(centred_target.T @ centred_source)
    handedness = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * handedness) @ right
    scale = float((singular * handedness).sum() / (centred_source**2).sum()) if with_scale else 1.0
    return scale, rotation, mean_target - scale * rotation @ mean_source
