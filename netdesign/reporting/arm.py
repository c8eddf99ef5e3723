"""The robot as a report draws it: link meshes in their own frames, and where the joints put them."""

from dataclasses import dataclass

import numpy as np

from netdesign.model.arrays import Floats, Ints
from netdesign.model.frames import transform
from netdesign.model.scene import Part
from netdesign.model.task import RobotCell
from netdesign.motion.kinematics import link_poses
from netdesign.motion.robot import Chain
from netdesign.reporting.mesh import light_mesh

TRIANGLES_PER_LINK = 1200


@dataclass(frozen=True, kw_only=True)
class LinkMesh:
    """Vertices (v, 3) m and faces (t, 3) in the frame of a link: 0 the base, i + 1 what joint i moves."""

    link: int
    vertices: Floats
    faces: Ints


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A robot in its cell.

    Attributes:
        placements: (r, 4, 4) as in ``motion.robot.Chain``.  last_from_cam: (4, 4), the camera in the last link's frame.
        obstacles: (b, 2, 3) m, centre and edge lengths of boxes along the world axes.
    """

    name: str
    world_from_base: Floats
    placements: Floats
    last_from_cam: Floats
    links: tuple[LinkMesh, ...]
    obstacles: Floats

    @classmethod
    def of(cls, cell: RobotCell, chain: Chain) -> "Arm":
        """Take from a cell what a picture needs."""
        links = []
        for shape in chain.shapes:
            vertices, faces = light_mesh(Part(vertices=shape.vertices, faces=shape.faces), TRIANGLES_PER_LINK)
            links.append(LinkMesh(link=shape.link, vertices=vertices, faces=faces))
        return cls(
            name=chain.name,
            world_from_base=cell.world_from_base,
            placements=chain.placements,
            last_from_cam=chain.last_from_flange @ cell.flange_from_cam,
            links=tuple(links),
            obstacles=np.stack([cell.obstacle_centres, cell.obstacle_sizes], axis=1),
        )

    def world_from_links(self, joints: Floats) -> Floats:
        """Return (r + 1, 4, 4) poses of the base and of every link for joints (r,) rad."""
        base_from_links = np.empty((len(self.placements), 3, 4))
        link_poses(self.placements, np.asarray(joints, dtype=np.float64), base_from_links)
        homogeneous = np.zeros((len(self.placements) + 1, 4, 4))
        homogeneous[0] = np.eye(4)
        homogeneous[1:, :3] = base_from_links
        homogeneous[:, 3, 3] = 1.0
        return np.asarray(self.world_from_base @ homogeneous)

    def posed(self, joints: Floats) -> list[tuple[Floats, Ints]]:
        """Return (vertices, faces) of every link in the world frame."""
        poses = self.world_from_links(joints)
        return [(transform(poses[mesh.link], mesh.vertices), mesh.faces) for mesh in self.links]


def box_mesh(centre: Floats, size: Floats, steps: int = 1) -> tuple[Floats, Ints]:
    """Return vertices and outward faces of a box along the axes, every side a grid of steps x steps squares.

    Small triangles are what lets the painter's order get a large table right.
    """
    ticks = np.linspace(-0.5, 0.5, steps + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(ticks, ticks, indexing="ij"))
    index = np.arange((steps + 1) ** 2).reshape(steps + 1, steps + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    quads = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    vertices: list[Floats] = []
    faces: list[Ints] = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            corners = np.empty((len(u), 3))
            corners[:, axis], corners[:, (axis + 1) % 3], corners[:, (axis + 2) % 3] = side, u, v
            faces.append((quads if side > 0 else quads[:, ::-1]) + len(vertices) * len(u))
            vertices.append(corners)
    return centre + size * np.concatenate(vertices), np.concatenate(faces)
