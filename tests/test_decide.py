"""Choosing a network: laws of the knee, brute force for the cheapest, and what an unmet requirement says."""

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netdesign import choose
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.design_json import read_design
from netdesign.placement import decide
from netdesign.placement.distances import network_total_error
from tests.runs import ring_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    ring_run(folder)
    return folder


def front_points(seed, count):
    """A convex front: f1 falls with f2 and f3."""
    generator = np.random.default_rng(seed)
    images = generator.integers(3, 15, count)
    tour = generator.uniform(1, 4, count)
    return np.stack([1e-4 / images / tour, tour, images], axis=1)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 30), st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3))
def test_the_knee_does_not_depend_on_units_or_order(seed, count, units):
    objectives = front_points(seed, count)
    permutation = np.random.default_rng(seed + 1).permutation(count)
    expected = objectives[decide.knee(objectives)]
    assert np.array_equal(objectives[permutation][decide.knee(objectives[permutation])], expected)
    assert np.allclose(decide.knee_distance(objectives * units), decide.knee_distance(objectives), atol=1e-9)


def test_the_knee_of_a_known_curve():
    # f1 f2 = 1 in logarithms is the plane itself; the bulge towards the origin is the knee.
    tour = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    objectives = np.stack([16.0 / tour, tour, np.ones(5)], axis=1)
    assert np.allclose(decide.knee_distance(objectives), 0.0, atol=1e-12)
    objectives[2, 0] /= 2
    assert decide.knee(objectives) == 2
    assert np.isclose(decide.knee_distance(objectives)[2], 0.25 / np.sqrt(2))


def test_a_front_of_one_network_and_a_tour_of_length_zero():
    assert decide.knee(np.array([[1.0, 2.0, 3.0]])) == 0
    assert np.isfinite(decide.knee_distance(np.array([[1.0, 0.0, 2.0], [0.5, 1.0, 3.0]]))).all()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 30))
def test_the_cheapest_is_that_of_brute_force(seed, count):
    objectives = front_points(seed, count)
    admissible = np.random.default_rng(seed).random(count) < 0.5
    admissible[0] = True
    ranked = sorted(np.flatnonzero(admissible), key=lambda k: (objectives[k, 2], objectives[k, 1], objectives[k, 0]))
    assert decide.cheapest(objectives, admissible) == ranked[0]


@given(st.floats(1e-9, 1e9))
def test_a_printed_limit_can_be_met(value):
    rounded = decide.round_up(value)
    assert value <= rounded <= value * (1 + 1.1e-3)


def test_the_chosen_network_meets_what_was_asked_and_nothing_cheaper_does(run):
    rows = choose.front_rows(run)
    limit = float(np.median([row.max_sigma_um for row in rows]))
    choice = choose.choose(run, max_sigma_um=limit)
    assert choice.row.max_sigma_um <= limit
    cheaper = [row for row in rows if (row.images, row.tour) < (choice.row.images, choice.row.tour)]
    assert all(row.max_sigma_um > limit for row in cheaper)
    assert choice.rule == "requirements"
    assert f"at most {limit:g} µm" in choice.reason


def test_the_knee_is_chosen_when_nothing_is_asked(run):
    choice = choose.choose(run)
    assert choice.rule == "knee"
    assert [row.network for row in choose.front_rows(run) if row.knee] == [choice.network]
    assert f"{choice.row.images} images" in choice.reason


def test_the_knee_within_limits(run):
    choice = choose.choose(run, knee=True, max_images=7 + 3)
    assert choice.rule == "knee"
    assert choice.row.images <= 10


def test_an_unmet_requirement_names_the_best_that_can_be_had_and_that_is_right(run):
    with pytest.raises(InfeasibleError, match="largest point sigma of at most 3 µm") as caught:
        choose.choose(run, max_sigma_um=3)
    best = float(re.search(r"the best has ([\d.]+) µm", str(caught.value))[1])
    assert choose.choose(run, max_sigma_um=best).row.max_sigma_um <= best


def test_two_requirements_that_exclude_each_other_are_both_named(run):
    rows = choose.front_rows(run)
    sigma = min(row.max_sigma_um for row in rows)
    images = min(row.images for row in rows)
    with pytest.raises(InfeasibleError, match="together") as caught:
        choose.choose(run, max_sigma_um=decide.round_up(sigma), max_images=images)
    assert "number of images" in str(caught.value)
    relief = float(re.search(r"largest point sigma ([\d.]+) µm \(asked", str(caught.value))[1])
    assert choose.choose(run, max_sigma_um=relief, max_images=images).row.images == images


def test_the_requirements_of_the_study_count_when_no_flag_is_given(tmp_path):
    ring_run(tmp_path / "run", requirements={"max_sigma_um": 16.0})
    choice = choose.choose(tmp_path / "run")
    assert choice.rule == "requirements"
    assert choice.row.max_sigma_um <= 16.0
    assert choose.choose(tmp_path / "run", knee=True).rule == "knee"


def test_a_distance_is_judged_by_the_full_covariance(tmp_path):
    study = {"distances": [{"from": "0.0", "to": "1.2", "u95_um": 60.0}]}
    task = ring_run(tmp_path / "run", requirements=study, sizes=range(8, 11))
    choice = choose.choose(tmp_path / "run")
    (asked,) = choice.requirements
    assert 0 < asked["value"] <= 60.0
    # The same from the joint covariance written out as a quadratic form.
    design = read_design(tmp_path / "run/design.json")
    total = network_total_error(task, choose.poses_of(design["networks"][choice.network]))
    points = task.scene.targets.points
    row = np.zeros(3 * len(points))
    row[0:3], row[18:21] = points[0] - points[6], points[6] - points[0]
    row /= np.linalg.norm(points[0] - points[6])
    assert np.isclose(asked["value"], 2e6 * np.sqrt(row @ total.joint() @ row), rtol=1e-9)


def test_a_distance_to_nowhere_is_an_input_error(tmp_path):
    ring_run(tmp_path / "run", requirements={"distances": [{"from": "0.0", "to": "999.0", "u95_um": 1}]})
    with pytest.raises(InputError, match=r"999\.0"):
        choose.choose(tmp_path / "run")


def test_records_are_plain_and_complete(run):
    records = choose.front(run)
    assert json.loads(json.dumps(records)) == records
    assert len({tuple(record) for record in records}) == 1
    choice = choose.choose(run)
    assert json.loads(json.dumps(choice.record))["network"] == choice.network
    assert choice.text.startswith(f"Network {choice.network:04d}")


def test_wrong_use_is_one_line(tmp_path, run):
    with pytest.raises(InputError, match="max-sigma-um"):
        choose.choose(run, max_sigma_um=-1)
    with pytest.raises(InputError, match=r"design\.json: no such file"):
        choose.front(tmp_path)
