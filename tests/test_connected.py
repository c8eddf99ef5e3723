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
from netdesign.placement.finish import finish
from netdesign.placement.infeasible import why_infeasible
from netdesign.placement.problem import Problem
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
