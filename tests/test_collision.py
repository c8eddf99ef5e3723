"""Collision: capsules contain their meshes and miss nothing that the real meshes touch."""

import numpy as np
import trimesh

from netdesign.motion.capsules import fit_capsules
from netdesign.motion.collision import FREE, LIMITS, OBSTACLE, PART, SELF, SIGHT, part_field, states
from netdesign.motion.kinematics import restarts
from tests.cells import PART as BOX
from tests.cells import arm
from tests.scenes import box_part


def distance_to_segment(points, start, end):
    along = end - start
    length = along @ along
    share = np.clip((points - start) @ along / length, 0, 1) if length > 0 else np.zeros(len(points))
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def test_capsules_contain_the_surface_of_every_link():
    rng = np.random.default_rng(1)
    for shape in arm().chain.shapes:
        corners = shape.vertices[shape.faces]
        weights = rng.dirichlet(np.ones(3), size=len(corners))
        surface = np.concatenate([shape.vertices, np.einsum("tk,tkx->tx", weights, corners)])
        capsules = fit_capsules(shape.vertices, shape.faces)
        gaps = [distance_to_segment(surface, c[:3], c[3:6]) - c[6] for c in capsules]
        assert np.min(gaps, axis=0).max() <= 1e-9, shape.name


def test_a_capsule_of_a_capsule_is_itself():
    mesh = trimesh.creation.capsule(height=0.3, radius=0.05)
    (capsule,) = fit_capsules(np.array(mesh.vertices), np.array(mesh.faces), most=1)
    assert abs(capsule[6] - 0.05) < 2e-3
    assert abs(np.linalg.norm(capsule[3:6] - capsule[:3]) - 0.3) < 0.01


def test_the_field_is_a_lower_bound_of_the_distance_and_zero_inside():
    size = np.array([0.24, 0.20, 0.16])
    field, origin, step = part_field(box_part(size))
    index = np.stack(np.meshgrid(*[np.arange(n) for n in field.shape], indexing="ij"), axis=-1)
    outside = np.maximum(np.abs(origin + step * index) - size / 2, 0.0)
    true = np.linalg.norm(outside, axis=-1)
    # Between cell centres the distance can be smaller by half a diagonal: the lookup takes the nearest centre.
    assert (field <= np.maximum(true - 0.5 * np.sqrt(3) * step, 0.0) + 1e-12).all()
    assert (true - field).max() < 3.5 * step
    assert (field[true == 0.0] == 0.0).all()


def test_capsules_miss_no_collision_of_the_real_meshes():
    """3000 random configurations against coal, the robot notes' criterion."""
    here = arm()
    joints = restarts(here.placed, 3000, seed=5)
    found = states(here.body, joints)
    touching = np.isin(found, (SELF, PART, OBSTACLE))
    assert np.bincount(found, minlength=SIGHT + 1)[[FREE, SELF, PART, OBSTACLE, SIGHT]].min() > 50
    assert not (found == LIMITS).any()
    free = joints[~touching][:600]
    assert not any(here.meshes.contact(q) for q in free)


def test_coal_says_what_the_arm_touches():
    here = arm()
    joints = restarts(here.placed, 400, seed=6)
    onto_table = [q for q in joints[states(here.body, joints) == OBSTACLE] if "obstacle" in here.meshes.contact(q)]
    assert len(onto_table) > 20
    assert any("obstacle 1" in here.meshes.contact(q) for q in onto_table)


def test_the_part_is_its_mesh_not_its_box():
    """A ring: the field is positive in its hole."""
    ring = trimesh.creation.annulus(r_min=0.15, r_max=0.2, height=0.05)
    from netdesign.model.scene import Part

    field, origin, step = part_field(Part(vertices=np.array(ring.vertices), faces=np.array(ring.faces)))
    centre = np.rint(-origin / step).astype(int)
    assert field[tuple(centre)] > 0.13
    assert field[tuple(np.rint((np.array([0.175, 0.0, 0.0]) - origin) / step).astype(int))] == 0.0


def test_pairs_that_are_tested_are_never_neighbours():
    here = arm()
    links = np.array(here.meshes.links)
    assert (np.abs(links[here.meshes.pairs[:, 0]] - links[here.meshes.pairs[:, 1]]) > 1).all()
    assert len(here.meshes.pairs) > 5
    assert BOX is not None
