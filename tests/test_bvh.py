import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from netdesign.photogrammetry.bvh import TriangleTree
from tests.scenes import box_part


def every_triangle(corners, origins, ends):
    """Möller–Trumbore of every segment with every triangle, by determinants: the oracle."""
    direction = (ends - origins)[:, None]
    first, second = corners[None, :, 1] - corners[None, :, 0], corners[None, :, 2] - corners[None, :, 0]
    offset = origins[:, None] - corners[None, :, 0]
    determinant = np.einsum("ktj,ktj->kt", np.cross(first, second), -direction)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.einsum("ktj,ktj->kt", np.cross(first, second), offset) / determinant
        u = np.einsum("ktj,ktj->kt", np.cross(offset, second), -direction) / determinant
        v = np.einsum("ktj,ktj->kt", np.cross(first, offset), -direction) / determinant
    return ((determinant != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any(axis=1)


@given(count=st.integers(0, 300), seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.02, 0.2, 2.0]))
@settings(deadline=None, max_examples=20)
def test_the_tree_finds_what_a_test_of_every_triangle_finds(count, seed, size):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    origins, ends = 2 * rng.normal(size=(100, 3)), rng.uniform(-1, 1, (100, 3))
    np.testing.assert_array_equal(
        TriangleTree.build(corners).blocked(origins, ends), every_triangle(corners, origins, ends)
    )


def test_axis_parallel_rays_and_flat_boxes():
    corners = np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[1, 1, 1], [0, 1, 1], [1, 0, 1]]], float)
    tree = TriangleTree.build(corners)
    inside = np.random.default_rng(1).uniform(0, 1, (500, 2))
    inside[0], inside[1], inside[2] = (0.5, 0.5), (0, 0.5), (0.25, 0.75)  # the shared edge, and the rim
    below = np.column_stack([inside, np.zeros(500)])
    assert tree.blocked(below, below + [0, 0, 2]).all()
    assert not tree.blocked(below, below + [0, 0, 0.999]).any()  # stops short
    assert not tree.blocked(below + [0, 0, 1.001], below + [0, 0, 3]).any()  # starts behind
    assert not tree.blocked(below, below + [5, 0, 0]).any()  # parallel to the plane


def test_a_ray_through_the_diagonal_of_a_face_does_not_slip_through():
    tree = TriangleTree.build(box_part((1, 1, 1)).triangles)
    diagonal = np.linspace(-0.49, 0.49, 200)
    for across in (diagonal, -diagonal):
        start = np.column_stack([diagonal, across, np.full(200, 2.0)])
        assert tree.blocked(start, np.tile([0.0, 0.0, 0.0], (200, 1)) + 0.9 * start * [1, 1, 0]).all()


@pytest.mark.parametrize("subdivisions", [1, 4])
def test_a_ball_hides_exactly_what_lies_behind_its_silhouette(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    rng = np.random.default_rng(2)
    origins, ends = 3 * rng.normal(size=(3000, 3)), 3 * rng.normal(size=(3000, 3))
    along = ends - origins
    nearest = origins + np.clip(-(origins * along).sum(1) / (along**2).sum(1), 0, 1)[:, None] * along
    distance = np.linalg.norm(nearest, axis=1)
    ends_outside = (np.linalg.norm(origins, axis=1) > 1) & (np.linalg.norm(ends, axis=1) > 1)
    blocked = TriangleTree.build(mesh.triangles).blocked(origins, ends)
    inner = np.abs(mesh.triangles.mean(axis=1)).max() * 0 + np.linalg.norm(mesh.triangles.mean(axis=1), axis=1).min()
    np.testing.assert_array_equal(blocked[ends_outside & (distance < inner)], True)
    np.testing.assert_array_equal(blocked[distance > 1], False)


def test_rounding_never_moves_a_triangle_out_of_its_box():
    corners = box_part((0.24, 0.2, 0.16), (1e3, -1e3, 1e3)).triangles
    centre = np.array([1e3, -1e3, 1e3])
    directions = np.random.default_rng(3).normal(size=(2000, 3))
    assert TriangleTree.build(corners).blocked(np.tile(centre, (2000, 1)), centre + directions).all()
