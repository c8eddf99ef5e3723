"""Collision: capsules contain their meshes and miss nothing that the real meshes touch."""

from dataclasses import replace

import coal
import numpy as np
import pytest
import trimesh

from netdesign.errors import InputError
from netdesign.motion.capsules import fit_capsules
from netdesign.motion.cell import load_arm
from netdesign.motion.collision import (
    FREE,
    LIMITS,
    OBSTACLE,
    PART,
    SELF,
    SIGHT,
    TOUCH,
    part_field,
    states,
)
from netdesign.motion.kinematics import restarts
from netdesign.motion.program import link_world_poses
from tests.cells import PART as BOX
from tests.cells import arm, cell
from tests.scenes import box_part, sphere


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


@pytest.mark.parametrize(("margin", "tower_x"), [(0.02, -0.72), (0.1, -0.75)])
def test_a_tower_beside_the_base_is_an_obstacle_for_every_link(margin, tower_x):
    """The base is within the margin of it, and shoulder and upper arm can turn away from it, so they keep theirs."""
    low, high = np.array([tower_x - 0.04, -0.3, 0.0]), np.array([tower_x + 0.04, 0.3, 0.13])
    table_and_pedestal = cell()
    beside = replace(
        table_and_pedestal,
        margin=margin,
        obstacle_centres=np.concatenate([table_and_pedestal.obstacle_centres, [0.5 * (low + high)]]),
        obstacle_sizes=np.concatenate([table_and_pedestal.obstacle_sizes, [high - low]]),
    )
    loaded = load_arm(beside, sphere(), BOX)
    q = restarts(loaded.placed, 300, seed=4)
    free = states(loaded.body, q) == FREE
    assert free.any()
    box = coal.CollisionObject(coal.Box(*(high - low)), np.eye(3), 0.5 * (low + high))
    shapes = [shape for shape in loaded.placed.shapes if shape.link in (1, 2)]
    solids = [coal.CollisionObject(_bvh(shape)) for shape in shapes]
    touched = 0
    for row, joints in enumerate(q):
        poses, gaps = link_world_poses(loaded, joints[None])[0], []
        for shape, solid in zip(shapes, solids, strict=True):
            solid.setTransform(coal.Transform3s(poses[shape.link - 1][:3, :3], poses[shape.link - 1][:3, 3]))
            gaps.append(coal.distance(solid, box, coal.DistanceRequest(), coal.DistanceResult()))
        kept = gaps[1] >= margin - 1e-6 and gaps[0] > 0.0  # the shoulder is nearer than 100 mm at every angle
        touched += not kept
        assert kept or not free[row]
        assert kept or loaded.meshes.contact(joints)
    assert touched > 20


def test_the_first_link_is_as_free_as_its_mesh():
    """The capsule of a UR10's shoulder is a ball that touches this tower at every angle: nothing could be reached."""
    tower = replace(
        cell(),
        obstacle_centres=[[0, 0, -0.11], [-0.75, 0, 0.128]],
        obstacle_sizes=[[0.9, 0.9, 0.02], [0.08, 0.6, 0.26]],
    )
    loaded = load_arm(tower, sphere(), BOX)
    q = restarts(loaded.placed, 300, seed=6)
    free = states(loaded.body, q) == FREE
    assert free.sum() > 20
    q[:, 1:] = [-1.57, 0.5, -1.0, 0.5, 0.0]  # the rest of the arm upright
    alone = [not loaded.meshes.contact(joints) for joints in q]
    told = states(loaded.body, q) != OBSTACLE
    assert not (told & ~np.array(alone)).any()
    assert 0 < told.sum() < len(q)


def _bvh(shape):
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(shape.faces), len(shape.vertices))
    mesh.addVertices(shape.vertices)
    mesh.addTriangles(shape.faces)
    mesh.endModel()
    return mesh


def test_what_the_base_stands_on_is_no_obstacle_for_the_links_above_it():
    wide = replace(cell(), margin=0.1)
    loaded = load_arm(wide, sphere(), BOX)
    assert loaded.meshes.mounting[1] == TOUCH  # the pedestal
    assert (loaded.body.turn == FREE).all()
    assert (states(loaded.body, restarts(loaded.placed, 300, seed=5)) == FREE).any()


def test_the_second_link_may_be_near_what_the_base_stands_on_but_never_touch_it():
    sizes = np.array([[0.9, 0.9, 0.02], [0.8, 0.8, 0.6]])  # a pedestal so wide that the upper arm can dip into it
    wide = replace(cell(), margin=0.1, obstacle_sizes=sizes)
    loaded = load_arm(wide, sphere(), BOX)
    assert loaded.body.mounting[1] == TOUCH
    pedestal = coal.CollisionObject(coal.Box(*sizes[1]), np.eye(3), np.asarray(wide.obstacle_centres[1]))
    (shape,) = [shape for shape in loaded.placed.shapes if shape.link == 2]
    upper = coal.CollisionObject(_bvh(shape))
    q = restarts(loaded.placed, 300, seed=7)
    q[:, 2:] = [0.5, -1.0, 0.5, 0.0]
    touching = np.zeros(len(q), np.bool_)
    for row, pose in enumerate(link_world_poses(loaded, q)):
        upper.setTransform(coal.Transform3s(pose[1][:3, :3], pose[1][:3, 3]))
        touching[row] = coal.collide(upper, pedestal, coal.CollisionRequest(), coal.CollisionResult()) > 0
    body = loaded.body
    own = body.capsule_link == 2  # only the upper arm: the rest of the arm must not answer for it
    alone = body._replace(
        capsules=np.ascontiguousarray(body.capsules[own]), capsule_link=body.capsule_link[own], camera_parts=0,
        pairs=body.pairs[:0], sight=body.sight[:0],
    )  # fmt: skip
    told = states(alone, q) != FREE  # an arm that low may be in the part as well
    assert touching.sum() > 20
    assert told[touching].all()
    assert all(loaded.meshes.contact(joints) for joints in q[touching])
    assert not told.all()  # nearer than the margin it is at every angle


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world_from_base": np.eye(4)}, r"robot\.base_position_mm: .* reaches into it"),
        (
            {"obstacle_centres": [[-0.6, 0, 0]], "obstacle_sizes": [[0.5, 0.5, 0.4]]},
            r"robot\.obstacles: .*found obstacle 1 .* at every angle",
        ),
    ],
)
def test_a_base_that_stands_in_something_is_named(changes, message):
    with pytest.raises(InputError, match=message):
        load_arm(replace(cell(), **changes), sphere(), BOX)
