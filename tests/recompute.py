"""The objectives of a design.json recomputed in plain numpy: an independent reading of the contract.

Shares no code with netdesign: TOML, mesh and CSV are read again, rays are cast by brute force, covariances come from a
textbook collinearity Jacobian, tours from a textbook nearest neighbour + 3-opt.
"""

import csv
import itertools
import json
import tomllib

import numpy as np
import trimesh


class Recomputed:
    """One run directory, read without netdesign; millimetres throughout."""

    def __init__(self, run):
        self.study = tomllib.loads((run / "study.toml").read_text())
        self.design = json.loads((run / "design.json").read_text())
        unit = {"mm": 1.0, "m": 1000.0, "inch": 25.4}[self.study["part"]["unit"]]
        roll, pitch, yaw = np.radians(self.study["part"]["rotation_deg"])
        c, s = np.cos, np.sin
        rx = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
        ry = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
        rz = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
        self.rotation, shift = rz @ ry @ rx, np.array(self.study["part"]["position_mm"])
        mesh = trimesh.load(run / self.study["part"]["mesh"], force="mesh", process=False)
        self.triangles = np.asarray(mesh.triangles) * unit @ self.rotation.T + shift
        self.centres, self.normals, self.points = [], [], []
        half = self.study["targets"]["size_mm"] / 2
        with (run / self.study["targets"]["file"]).open() as file:
            for row in csv.DictReader(file):
                centre, normal, x = (
                    self.rotation @ [float(row[key]) for key in keys]
                    for keys in (("x_mm", "y_mm", "z_mm"), ("nx", "ny", "nz"), ("ux", "uy", "uz"))
                )
                normal = normal / np.linalg.norm(normal)
                x = x - normal * (normal @ x)
                x = x / np.linalg.norm(x)
                y = np.cross(normal, x)
                self.centres.append(centre + shift)
                self.normals.append(normal)
                self.points.append(
                    [centre + shift + half * (a * x + b * y) for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
                )
        self.centres, self.normals, self.points = map(np.array, (self.centres, self.normals, self.points))
        self.camera = self.study["camera"]

    def project(self, world_from_cam, points):
        """(…, 2) px and (…,) depth, the distortion of OpenCV."""
        local = (points - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
        x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
        k1, k2, p1, p2 = self.camera["distortion"]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        (fx, fy), (cx, cy) = self.camera["focal_px"], self.camera["principal_point_px"]
        return np.stack([fx * u + cx, fy * v + cy], axis=-1), local[..., 2]

    def visible(self, world_from_cam):
        """(g,) whether each tag is seen, by the contract's definition."""
        limits, camera = self.study["visibility"], self.camera
        xy, depth = self.project(world_from_cam, self.points)
        centre = world_from_cam[:3, 3]
        rays = centre - self.points
        cosine = np.einsum("gci,gi->gc", rays, self.normals) / np.linalg.norm(rays, axis=2)
        border = limits["border_px"]
        size = np.array([camera["width_px"], camera["height_px"]])
        inside = ((xy >= border - 0.5) & (xy <= size - 0.5 - border)).all(axis=(1, 2))
        edges = np.linalg.norm(xy - np.roll(xy, -1, axis=1), axis=2)
        seen = (
            (depth > 0).all(axis=1)
            & (cosine >= np.cos(np.radians(limits["max_incidence_deg"]))).all(axis=1)
            & inside
            & (edges.min(axis=1) >= limits["min_tag_px"])
        )
        if {"pixel_um", "f_number", "focus_mm"} <= set(camera):
            pitch = camera["pixel_um"] * 1e-3
            focus, image = camera["focus_mm"], camera["focal_px"][0] * pitch
            focal = 1 / (1 / focus + 1 / image)
            reach = camera["f_number"] * camera["dof_blur_px"] * pitch * (focus - focal) / focal**2
            seen &= (depth >= focus / (1 + reach)).all(axis=1)
            if reach < 1:
                seen &= (depth <= focus / (1 - reach)).all(axis=1)
        if limits["occlusion"]:
            for tag in np.flatnonzero(seen):
                ends = np.vstack([self.points[tag], self.centres[tag]])
                seen[tag] = not any(self.blocked(centre, end) for end in ends)
        return seen

    def blocked(self, start, end):
        """Möller and Trumbore against every triangle; the last 1e-6 of the ray is free."""
        a, b, c = self.triangles[:, 0], self.triangles[:, 1], self.triangles[:, 2]
        ray, e1, e2 = end - start, b - a, c - a
        p = np.cross(ray, e2)
        determinant = np.einsum("ti,ti->t", e1, p)
        hit = np.abs(determinant) > 1e-12
        inverse = 1 / np.where(hit, determinant, 1)
        s = start - a
        u = np.einsum("ti,ti->t", s, p) * inverse
        q = np.cross(s, e1)
        v = q @ ray * inverse
        t = np.einsum("ti,ti->t", e2, q) * inverse
        return bool((hit & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-6)).any())

    def f1(self, poses):
        """Mean variance of limited error propagation in mm², and the rays of every object point."""
        sigma = self.camera["sigma_px"]
        normal = np.zeros((len(self.centres), 4, 3, 3))
        rays = np.zeros((len(self.centres), 4), dtype=int)
        step = 1e-3
        for pose in poses:
            seen = self.visible(pose)
            rays[seen] += 1
            points = self.points[seen]
            jacobian = np.stack(
                [
                    # Richardson's extrapolation of the central difference: error of order step^4.
                    (4 * (self.project(pose, points + h / 2)[0] - self.project(pose, points - h / 2)[0]) / step
                     - (self.project(pose, points + h)[0] - self.project(pose, points - h)[0]) / (2 * step)) / 3
                    for h in step * np.eye(3)
                ],
                axis=-1,
            )  # fmt: skip
            normal[seen] += np.einsum("gcki,gckj->gcij", jacobian, jacobian) / sigma**2
        covariance = np.linalg.inv(normal)
        return float(np.trace(covariance, axis1=2, axis2=3).sum() / (3 * rays.size)), rays.ravel()


def path_length(distance, order):
    """Length of the open path."""
    return float(sum(distance[a, b] for a, b in itertools.pairwise(order)))


def nearest_neighbour_3opt(distance, start):
    """Nearest neighbour from ``start``, then 3-opt moves of the open path until none helps."""
    count = len(distance)
    order, left = [start], set(range(count)) - {start}
    while left:
        order.append(min(left, key=lambda node: distance[order[-1], node]))
        left.remove(order[-1])
    best, improved = path_length(distance, order), True
    while improved:
        improved = False
        for i, j, k in itertools.combinations_with_replacement(range(1, count + 1), 3):
            head, first, second, tail = order[: i - 1], order[i - 1 : j - 1], order[j - 1 : k], order[k:]
            for a, b in itertools.permutations((first, second)):
                for x, y in itertools.product((a, a[::-1]), (b, b[::-1])):
                    candidate = head + x + y + tail
                    length = path_length(distance, candidate)
                    if length < best - 1e-12:
                        order, best, improved = candidate, length, True
                        break
                else:
                    continue
                break
            if improved:
                break
    return best
