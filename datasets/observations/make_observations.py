"""Writes the observation set of this folder: image points of a measured gauge, as another program would hand them over.

    python datasets/observations/make_observations.py [FOLDER]

A gauge of 40 targets on a body of 400 x 300 x 120 mm, twelve stations about a metre away, some rolled by 90 degrees;
image points of 0.1 px, two of them spoilt by 4 and 7 px; a lens that the COLMAP model knows only from its catalogue;
two scale bars between targets, and three targets with coordinates from a measuring machine. The truth is in this
script alone.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from netdesign.model.frames import exp_rotation, inverse, look_at
from netdesign.photogrammetry.collinearity import project

LENS = np.array([3620.0, 3620.0, 1228.0, 1019.0, -0.09, 0.11, 2e-4, -1e-4])
CATALOGUE = np.array([3600.0, 3600.0, 1223.5, 1023.5, 0.0, 0.0, 0.0, 0.0])
SIGMA_PX = 0.1
SPOILT = {57: (4.0, 0.5), 230: (-2.0, 6.7)}


def main(folder: Path) -> None:
    """Write the files."""
    random = np.random.default_rng(2634)
    points = random.uniform([-0.2, -0.15, -0.06], [0.2, 0.15, 0.06], (40, 3))
    azimuth = np.arange(12) * np.pi / 6
    elevation = np.radians(random.uniform(35, 70, 12))
    eyes = np.c_[np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    poses = look_at(eyes, np.zeros(3), (np.arange(12) % 4 == 1) * np.pi / 2)
    visible = random.random((12, 40)) < 0.85
    visible[:3] = True
    image, point = np.nonzero(visible)
    xy, _ = project(poses[image], points[point], LENS)
    xy = xy + SIGMA_PX * random.standard_normal(xy.shape)
    for row, error in SPOILT.items():
        xy[row] += error

    start = poses.copy()
    start[:, :3, 3] += 0.004 * random.standard_normal((12, 3))
    start[:, :3, :3] = start[:, :3, :3] @ exp_rotation(0.004 * random.standard_normal((12, 3)))
    rough = np.round((points + 0.002 * random.standard_normal(points.shape)) * 1e3, 1)
    cam_from_world = inverse(start)
    quaternion = Rotation.from_matrix(cam_from_world[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    names = [f"station {index + 1:02d}.jpg" for index in range(12)]

    fx, _, cx, cy = CATALOGUE[:4]
    write(folder / "cameras.txt", [f"1 OPENCV 2448 2048 {fx:g} {fx:g} {cx + 0.5:g} {cy + 0.5:g} 0 0 0 0"])
    lines = []
    for index, name in enumerate(names):
        numbers = [f"{x:.9f}" for x in quaternion[index]] + [f"{x * 1e3:.4f}" for x in cam_from_world[index, :3, 3]]
        lines += [f"{index + 1} {' '.join(numbers)} 1 {name}", ""]
    write(folder / "images.txt", lines)
    write(folder / "points3D.txt", [f"{j + 1} {x} {y} {z} 128 128 128 0" for j, (x, y, z) in enumerate(rough.tolist())])
    variance = SIGMA_PX**2
    rows = [
        f"{names[i]},{j + 1},{u:.4f},{v:.4f},{variance:g},0,{variance:g}"
        for i, j, (u, v) in zip(image.tolist(), point.tolist(), xy.tolist(), strict=True)
    ]
    write(folder / "observations.csv", ["image,point,x_px,y_px,sxx_px2,sxy_px2,syy_px2", *rows])
    far = farthest(points)
    lengths = [np.linalg.norm(points[a] - points[b]) * 1e3 + 0.005 * random.standard_normal() for a, b in far]
    bars = [f"{a + 1},{b + 1},{length:.4f},0.005" for (a, b), length in zip(far, lengths, strict=True)]
    write(folder / "scalebars.csv", ["a,b,length_mm,sigma_mm", *bars])
    corners = [int(np.argmax(points @ direction)) for direction in ([1, 1, 0], [-1, 1, 0], [0, -1, 0])]
    measured = points[corners] * 1e3 + 0.004 * random.standard_normal((3, 3))
    control = [
        f"{j + 1},{x:.4f},{y:.4f},{z:.4f},0.004" for j, (x, y, z) in zip(corners, measured.tolist(), strict=True)
    ]
    write(folder / "machine.csv", ["point,x_mm,y_mm,z_mm,sigma_mm", *control])


def farthest(points: np.ndarray) -> list[tuple[int, int]]:
    """Return the longest pair of points and the longest of those most across it."""
    a, b = np.unravel_index(np.argmax(np.linalg.norm(points[:, None] - points[None], axis=2)), (40, 40))
    axis = (points[b] - points[a]) / np.linalg.norm(points[b] - points[a])
    across = np.linalg.norm(np.cross(points[:, None] - points[None], axis), axis=2)
    c, d = np.unravel_index(np.argmax(across), (40, 40))
    return [(int(a), int(b)), (int(c), int(d))]


def write(path: Path, lines: list[str]) -> None:
    """Write lines of text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "gauge")
