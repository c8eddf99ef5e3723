"""Design to a tolerance: the answer keeps every limit, nothing of the front is cheaper, and what is promised holds."""

import re
import subprocess
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w

from netdesign import choose
from netdesign.errors import InfeasibleError, InputError
from netdesign.files.design_json import write_design
from netdesign.model.results import PointPrecision
from netdesign.placement.distances import distance_u95, named_ends
from netdesign.placement.finish import finish
from netdesign.placement.problem import Problem
from netdesign.search.engine import run
from netdesign.starter import write_starter
from tests.runs import front_of, ring_run, ring_viewpoints
from tests.scenes import plate_scene
from tests.test_placement import task_of


def designed(max_images=8, **requirements):
    problem = Problem.build(task_of(plate_scene(side=3), max_images=max_images, requirements=requirements))
    return problem, finish(problem, run(problem, "memetic", 30, 40, 1))


def largest_um(network):
    return 1e6 * network.precision.sigma.max()


def test_the_cheapest_network_that_meets_the_largest_sigma_is_the_answer():
    _, free = designed()
    limit = float(
        np.median([min(largest_um(n) for n in free.networks if n.f3 == k) for k in {n.f3 for n in free.networks}])
    )
    _, design = designed(max_sigma_um=limit)
    answer = design.networks[design.answer]
    assert largest_um(answer) <= limit
    for network in (*design.networks, *free.networks):
        if largest_um(network) <= limit:
            assert (answer.f3, answer.f2) <= (network.f3, network.f2 * (1 + 1e-9))
    objectives = np.array([[network.f1, network.f2, network.f3] for network in design.networks])
    for row in objectives:
        assert (objectives <= row).all(axis=1).sum() == 1


@pytest.mark.parametrize(("limit", "stages"), [(60.0, {"requirements"}), (1.0, {"requirements", "more images"})])
def test_the_way_to_an_answer_is_reported(limit, stages):
    """Every stage says how far it is and comes to its end, whether an answer is found or not."""
    problem = Problem.build(task_of(plate_scene(side=3), max_images=4, requirements={"max_sigma_um": limit}))
    calls = []

    def progress(stage, done, total, note=""):
        calls.append((stage, done, total))

    finish(problem, run(problem, "memetic", 20, 10, 1), progress)
    assert stages == {stage for stage, _, _ in calls} & {"requirements", "more images"}
    for stage in stages:
        own = [(done, total) for name, done, total in calls if name == stage]
        assert own[0][0] == 0
        assert own[-1][0] == own[-1][1]
        assert all(done <= total for done, total in own)


def test_a_distance_decides_through_the_full_covariance():
    asked = {"from": "0.0", "to": "8.2", "u95_um": 45.0}
    problem, design = designed(distances=[asked])
    answer = design.networks[design.answer]
    ends = named_ends(problem.task)
    assert distance_u95(problem.task, answer.world_from_cam, ends)[0] <= 45.0e-6
    for network in design.networks:
        if distance_u95(problem.task, network.world_from_cam, ends)[0] <= 45.0e-6:
            assert (answer.f3, answer.f2) <= (network.f3, network.f2)


@pytest.mark.parametrize(
    "asked",
    [{"max_sigma_um": 8.0}, {"distances": [{"from": "0.0", "to": "8.2", "u95_um": 18.0}], "max_sigma_um": 30.0}],
)
def test_what_is_said_to_be_enough_is_enough(asked):
    _, design = designed(max_images=5, **asked)
    assert design.answer is None
    best = float(re.search(r"at best ([\d.]+) µm", design.answer_reason)[1])
    required = float(re.search(r"required ([\d.]+)\) with 5 images", design.answer_reason)[1])
    assert best > required
    enough = int(re.search(r"(\d+) images would reach it", design.answer_reason)[1])
    assert enough > 5
    _, larger = designed(max_images=enough, **asked)
    assert larger.answer is not None
    assert larger.networks[larger.answer].f3 <= enough


def test_a_tour_limit_that_cannot_be_kept_names_the_tour_that_can():
    limit = 700.0
    _, design = designed(max_images=5, max_sigma_um=11.0, max_tour=limit)
    assert design.answer is None
    assert "within requirements.max_tour" in design.answer_reason
    tour = float(re.search(r"a tour of ([\d.]+) mm", design.answer_reason)[1])
    assert tour > limit
    _, longer = designed(max_images=5, max_sigma_um=11.0, max_tour=1.2 * tour)
    assert longer.answer is not None
    problem = Problem.build(task_of(plate_scene(side=3), max_images=4, requirements={"max_tour": 1e-3}))
    with pytest.raises(InfeasibleError, match=r"the shortest one found takes [\d.]+ mm"):
        finish(problem, run(problem, "memetic", 8, 4, 1))


def test_more_images_are_promised_beyond_a_tour_limit_too():
    _, design = designed(max_images=5, max_sigma_um=7.0, max_tour=700.0)
    assert re.search(r"within requirements.max_tour with \d images; \d+ images would reach it", design.answer_reason)


def test_choose_repeats_the_reason(tmp_path):
    task = ring_run(tmp_path / "run", requirements={"max_sigma_um": 1.0})
    design = front_of(task, [ring_viewpoints(12, 32, False)])
    design = replace(design, answer_reason="no network meets the requirements: because")
    write_design(tmp_path / "run/design.json", task, design)
    with pytest.raises(InfeasibleError, match="because"):
        choose.choose(tmp_path / "run")
    assert choose.choose(tmp_path / "run", knee=True).network == 0


def test_a_flagged_network_is_the_knee_only_when_all_are(tmp_path):
    task = ring_run(tmp_path / "run")
    design = front_of(task, [ring_viewpoints(count, 32, False) for count in (8, 10, 13)])
    assert len(design.networks) > 1
    write_design(tmp_path / "run/design.json", task, design)
    knee = choose.choose(tmp_path / "run").network
    flagged = replace(design.networks[knee], flagged=True)
    networks = [flagged if place == knee else network for place, network in enumerate(design.networks)]
    write_design(tmp_path / "run/design.json", task, replace(design, networks=tuple(networks)))
    assert choose.choose(tmp_path / "run").network != knee
    assert not next(row for row in choose.front_rows(tmp_path / "run") if row.network == knee).knee
    # A ratio of total to limited variance above 1.5 counts as a flag, whatever the file says of it.
    total = design.networks[knee].total
    wide = PointPrecision(covariance=2 * total.covariance, rays=total.rays, propagation="total", datum=total.datum)
    networks[knee] = replace(design.networks[knee], total=wide)
    write_design(tmp_path / "run/design.json", task, replace(design, networks=tuple(networks)))
    assert choose.choose(tmp_path / "run").network != knee
    networks = [replace(network, flagged=True) for network in design.networks]
    write_design(tmp_path / "run/design.json", task, replace(design, networks=tuple(networks)))
    assert choose.choose(tmp_path / "run").network == knee


def test_a_distance_between_unknown_points_is_refused_before_the_search():
    with pytest.raises(InputError, match=r"99\.0"):
        Problem.build(
            task_of(plate_scene(side=3), requirements={"distances": [{"from": "0.0", "to": "99.0", "u95_um": 1}]})
        )


def test_the_command_writes_the_front_and_leaves_with_3(tmp_path):
    """A script learns from the exit status that no network keeps the requirements; the front is there all the same."""
    starter = write_starter(tmp_path / "part", "plate")
    study = tomllib.loads(starter.read_text())
    study["search"] = {"population": 8, "generations": 4}
    study["requirements"] = {"max_sigma_um": 1e-3}
    starter.write_text(tomli_w.dumps(study))
    for more in ([], ["--resume"]):
        command = [sys.executable, "-m", "netdesign", "design", str(starter), "-o", str(tmp_path / "run"), *more]
        found = subprocess.run(command, capture_output=True, text=True, check=False)
        assert found.returncode == 3, found.stderr
        assert "networks" in found.stdout
        assert found.stderr.splitlines()[-1].startswith("netdesign: requirements: no network meets the requirements:")
        assert len(choose.front(tmp_path / "run")) > 0
