"""Tags spread over the faces of a part: inside their face, and on parts whose faces are triangles too."""

import numpy as np
import pytest
import trimesh

from netdesign.errors import InputError
from netdesign.files.parts import spread_targets
from netdesign.model.scene import Part

QUIET = 10 / 8  # a tag with its quiet zone, in tag edges


def part_of(mesh):
    return Part(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces))


def inside_its_face(part, targets):
    """(g,) whether the square with the quiet zone lies in the one triangle whose plane it is in."""
    half = QUIET * targets.size_m / 2
    up = np.cross(targets.normals, targets.x_axes)
    triangles = np.asarray(part.triangles)
    found = []
    for centre, normal, x, y in zip(targets.centres, targets.normals, targets.x_axes, up, strict=True):
        corners = centre + half * np.array([a * x + b * y for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))])
        on_plane = [t for t in triangles if np.abs((corners - t[0]) @ normal).max() < 1e-9]
        sides = [np.einsum("kx,x->k", np.cross(t[(e + 1) % 3] - t[e], corners - t[e]), normal) for t in on_plane
                 for e in range(3)]  # fmt: skip
        found.append(any((np.array(sides[3 * i : 3 * i + 3]) > -1e-12).all() for i in range(len(on_plane))))
    return np.array(found)


@pytest.mark.parametrize(("spacing", "count"), [(0.04, 32), (0.08, 20)])
def test_triangular_faces_carry_tags(spacing, count):
    """The middle of a triangle's bounding box is not the middle of the triangle."""
    part = part_of(trimesh.creation.icosahedron().apply_scale(0.145))
    targets = spread_targets(part, "tag36h11", 0.03, spacing)
    assert len(targets.ids) == count
    assert inside_its_face(part, targets).all()


def test_a_box_carries_a_centred_grid():
    part = part_of(trimesh.creation.box(extents=[0.2, 0.2, 0.2]))
    targets = spread_targets(part, "tag36h11", 0.03, 0.05)
    assert len(targets.ids) == 6 * 16
    for normal in np.vstack([np.eye(3), -np.eye(3)]):
        mine = targets.normals @ normal > 0.9
        np.testing.assert_allclose(targets.centres[mine].mean(axis=0), 0.1 * normal, atol=1e-12)


def test_a_part_without_room_is_refused_with_its_largest_face():
    part = part_of(trimesh.creation.icosahedron().apply_scale(0.05))
    with pytest.raises(InputError, match=r"no flat face .* 37.5 mm .* largest flat face has \d+ mm²"):
        spread_targets(part, "tag36h11", 0.03, 0.08)
