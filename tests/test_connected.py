"""Networks whose images do not hang together are no networks: the search refuses them, and says so."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netdesign.errors import InfeasibleError
from netdesign.model.scene import Targets
from netdesign.photogrammetry.connectivity import loose_images
from netdesign.placement import evaluation
from netdesign.placement.finish import UNDETERMINED, Exact, finish
from netdesign.placement.infeasible import why_infeasible
from netdesign.placement.problem import Problem
from netdesign.placement.ties import tying_stations
from netdesign.search.engine import run, start
from tests.scenes import box_scene, plate_scene, sphere
from tests.test_placement import task_of


def packed(sees):
    """(n, words) uint64 of tags (n, g), as the visibility map keeps them."""
    room = np.zeros((len(sees), -(-sees.shape[1] // 64) * 64), np.uint8)
    room[:, : sees.shape[1]] = sees
    return np.packbits(room, axis=1, bitorder="little").view(np.uint64)


@given(st.integers(1, 9), st.integers(1, 130), st.floats(0.0, 0.3), st.integers(0, 10**6))
def test_the_kernel_counts_as_the_graph_does(images, tags, share, seed):
    sees = np.random.default_rng(seed).random((images, tags)) < share
    words = packed(sees)
    assert evaluation.loose_images(np.arange(images), words, np.zeros(words.shape[1], np.uint64)) == loose_images(sees)


def test_a_chain_hangs_together_and_two_chains_do_not():
    chain = np.eye(5, 6, dtype=bool) | np.eye(5, 6, 1, dtype=bool)
    assert loose_images(chain) == 0
    assert loose_images(chain[[0, 1, 3, 4]]) == 2
    assert loose_images(np.concatenate([chain, np.zeros((1, 6), bool)])) == 0  # sees nothing: another complaint's task


def test_every_feasible_network_hangs_together():
    problem = Problem.build(task_of(box_scene(spacing=0.07), max_images=16, min_rays=3))
    bits, genes = problem.seeds()
    rng = np.random.default_rng(3)
    more, other = problem.random(rng, 300)
    bits, genes = np.concatenate([bits, more]), np.concatenate([genes, other])
    _, violation = problem.evaluate(bits, genes)
    assert (violation <= 0).sum() > 5
    for row in np.flatnonzero(violation <= 0):
        assert loose_images(problem.sees(genes[row][bits[row]])) == 0


def test_a_part_in_two_halves_is_refused_with_the_reason():
    """Two plates back to back: no image sees a tag of both."""
    task = task_of(plate_scene(side=3), max_images=8, min_rays=2)
    one = task.scene.targets
    turn = np.diag([1.0, -1.0, -1.0])
    both = Targets(
        ids=np.arange(2 * len(one.ids)),
        centres=np.concatenate([one.centres, one.centres @ turn + [0, 0, -0.01]]),
        normals=np.concatenate([one.normals, one.normals @ turn]),
        x_axes=np.concatenate([one.x_axes, one.x_axes @ turn]),
        size_m=one.size_m,
    )
    task = replace(task, scene=replace(task.scene, targets=both), sphere=sphere(max_images=8, elevation=(-90, 90)))
    problem = Problem.build(task)
    with pytest.raises(InfeasibleError, match="share no object point with the others"):
        finish(problem, run(problem, "memetic", 20, 10, 1))


@given(st.integers(2, 4), st.integers(0, 10**6))
def test_two_images_tie_two_groups(groups, seed):
    """Groups of three tags, of which connectors see one or two of two neighbours: a chain needs a pair for each gap."""
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(groups), 3)
    sees = np.repeat(group == np.arange(groups)[:, None], 2, axis=0)
    left = np.repeat(np.arange(groups - 1), 5)
    connectors = ((group == left[:, None]) | (group == left[:, None] + 1)) & (rng.random((len(left), 3 * groups)) < 0.5)
    connectors[:, ::3] |= (group == left[:, None])[:, ::3] | (group == left[:, None] + 1)[:, ::3]
    directions = rng.normal(size=(len(left), 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = tying_stations(sees, directions, connectors, 20)
    assert len(np.unique(found)) == len(found) == 2 * (groups - 1)
    assert sorted(left[found].tolist()) == sorted(2 * list(range(groups - 1)))
    assert loose_images(np.concatenate([sees, connectors[found]])) == 0
    assert len(tying_stations(sees, directions, connectors, 1)) == 0
    assert len(tying_stations(sees, directions, np.zeros_like(connectors), 20)) == 0


def test_faces_at_right_angles_are_tied_where_an_image_sees_barely_two(monkeypatch):
    """A block with tags on its sides, seen at 50 degrees at most: a set cover looks at the faces one by one."""
    task = task_of(box_scene(spacing=0.07), max_images=24, min_rays=3)
    task = replace(
        task,
        limits=replace(task.limits, max_incidence=np.radians(50.0)),
        sphere=sphere(max_images=24, elevation=(-30, 90)),
    )
    problem = Problem.build(task)
    assert loose_images(problem.sees(problem.cover.viewpoints)) > 0
    bits, genes = problem.seeds()
    _, violation = problem.evaluate(bits, genes)
    assert (violation <= 0).any()
    state = run(problem, "memetic", 24, 3, 1)
    design = finish(problem, state)
    assert all(network.total is not None for network in design.networks)
    # Where nothing of what the search kept is determined, what it began with may be.
    exact, kept = Exact.network, len(state.archive.members)

    def after_the_archive(self, viewpoints):
        nonlocal kept
        kept -= 1
        return UNDETERMINED if kept >= 0 else exact(self, viewpoints)

    monkeypatch.setattr(Exact, "network", after_the_archive)
    assert finish(problem, state).networks


def test_a_tag_that_no_candidate_sees_is_named_and_no_error(monkeypatch):
    """As a robot's reach makes of it: the map of what is seen does not know the reach, the candidates do."""
    problem = Problem.build(task_of(plate_scene(side=3), max_images=6, min_rays=2))
    sees = Problem.sees
    monkeypatch.setattr(Problem, "sees", lambda self, viewpoints: sees(self, viewpoints) & (np.arange(9) != 4))
    _, genes = problem.seeds()
    assert np.isfinite(genes).all()
    state = start(problem, "memetic", 8, 1)
    assert why_infeasible(problem, state).startswith("1 of 9 tags are seen by fewer than 2 of ")
    assert "tags 4 (by 0)" in why_infeasible(problem, state)


def test_images_without_a_point_are_named_where_none_is_asked_for():
    task = task_of(plate_scene(side=2), max_images=4, min_rays=2)
    limits = replace(task.limits, min_points_per_image=0)
    problem = Problem.build(replace(task, limits=limits, sphere=sphere(max_images=4, elevation=(-90, 90))))
    state = start(problem, "memetic", 8, 1)
    from_below = np.full_like(state.population.genes, -1.5)
    said = why_infeasible(problem, replace(state, population=replace(state.population, genes=from_below)))
    assert "images see no object point" in said
    assert "fewer than 0" not in said


def test_a_sigma_of_the_size_of_the_object_is_none():
    """Two stations 0.05 degrees apart: sigma_px / f · 0.6 m / 0.0009 rad is 20 mm, a seventh of the plate's radius."""
    exact = Exact(Problem.build(task_of(plate_scene(side=4), max_images=4, min_rays=2)))
    assert exact.network(np.radians([[0.0, 70.0], [0.0, 70.05]])) == UNDETERMINED
    wider = exact.network(np.radians([[0.0, 70.0], [0.0, 75.0]]))
    assert not isinstance(wider, str)
    assert wider.total is not None
