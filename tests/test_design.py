"""The verb design: recomputed without netdesign, byte-identical whatever the threads, clear refusals."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from netdesign.motion.robot import load_chain
from netdesign.motion.timing import leg_time
from netdesign.report import read_run
from netdesign.reporting.articles import article
from netdesign.reporting.mesh import PartMesh
from netdesign.reporting.payload import payload
from tests.recompute import Recomputed, nearest_neighbour_3opt, path_length

DATASETS = Path(__file__).parents[1] / "datasets"

STUDY = f"""format = 1
name = "small"
[part]
mesh = "{DATASETS}/parts/plate.stl"
[targets]
size_mm = 20
file = "{DATASETS}/parts/plate_tags.csv"
[camera]
width_px = 1600
height_px = 1200
focal_px = [2100, 2100]
principal_point_px = [799.5, 599.5]
distortion = [-0.08, 0.02, 0.0003, -0.0002]
[viewpoints]
radius_mm = 600
elevation_deg = [20, 90]
max_images = 8
[search]
population = 40
generations = 10
max_networks = 12
"""
ROBOT = """[robot]
name = "ur10"
base_position_mm = [-600, 0, 0]
"""


def design(folder, study, *options):
    path = folder / "study.toml"
    path.write_text(study)
    command = [sys.executable, "-m", "netdesign", "design", str(path), "-o", str(folder / "run"), *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module", params=["workspace", "joint"])
def run(request, tmp_path_factory):
    """A finished design over the plate, with and without a robot."""
    folder = tmp_path_factory.mktemp(request.param)
    result = design(folder, STUDY + (ROBOT if request.param == "joint" else ""))
    assert result.returncode == 0, result.stderr
    return folder / "run"


def test_objectives_recomputed_in_plain_numpy(run):
    again = Recomputed(run)
    assert len(again.design["networks"]) >= 4
    for network in again.design["networks"]:
        poses = np.array(network["world_from_cam_mm"])
        f1, rays = again.f1(poses)
        assert f1 == pytest.approx(network["objectives"][0], rel=1e-9)
        assert network["objectives"][2] == len(poses)
        assert rays.tolist() == network["rays"]
        assert rays.min() >= 3
        joints = network["joints_rad"]
        nodes = poses[:, :3, 3] if joints is None else np.array(joints)
        distance = np.linalg.norm(nodes[:, None] - nodes, axis=2)
        assert path_length(distance, range(len(nodes))) == pytest.approx(network["objectives"][1], rel=1e-9)
        best = min(nearest_neighbour_3opt(distance, start) for start in range(len(nodes)))
        assert network["objectives"][1] <= best * (1 + 1e-9)


def test_the_report_counts_legs_as_the_tour_does(run, tmp_path):
    """Over via points too: put into the design of a copy, as an obstacle would."""
    for network in read_run(run).networks:
        assert network.legs.sum() == pytest.approx(network.tour, rel=1e-9)
    content = json.loads((run / "design.json").read_text())
    first = content["networks"][0]
    if first["joints_rad"] is None:
        assert first["vias_rad"] is None
        return
    assert [len(points) for points in first["vias_rad"]] == [0] * (len(first["joints_rad"]) - 1)
    start, end = np.array(first["joints_rad"][1:3])
    over = start + np.array([0.3, 0, 0, 0, 0, -0.4])
    first["vias_rad"][1] = [over.tolist()]
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "design.json").write_text(json.dumps(content))
    record = read_run(tmp_path / "run")
    network = record.networks[0]
    assert network.legs[1] == pytest.approx(0.5 + np.linalg.norm(end - over), rel=1e-12)
    assert [row[9] for row in article(record, network, b"")["tour"]["rows"]][2].endswith(" over 1 via")
    mesh = PartMesh.of(record.task.scene.part, 100)
    assert payload(record, mesh)["networks"][0]["vias"] == {"1": pytest.approx(over, abs=1e-5)}
    study = tmp_path / "run" / "study.toml"
    study.write_text(study.read_text().replace('motion = "joint"', 'motion = "time"'))
    chain = load_chain(record.task.cell)
    timed = read_run(tmp_path / "run").networks[0]
    expected = sum(leg_time(*pair, chain.speed, chain.acceleration) for pair in ((start, over), (over, end)))
    assert timed.legs[1] == pytest.approx(expected, rel=1e-12)


def test_no_network_of_the_front_is_dominated(run):
    networks = json.loads((run / "design.json").read_text())["networks"]
    values = np.array([network["objectives"] for network in networks])
    for one in values:
        dominated_by = np.all(values <= one, axis=1) & np.any(values < one, axis=1)
        assert not dominated_by.any()
    for size in np.unique(values[:, 2]):
        layer = values[values[:, 2] == size]
        layer = layer[np.argsort(-layer[:, 0])]
        assert np.all(np.diff(layer[:, 1]) > 0)
    assert [network["id"] for network in networks] == list(range(len(networks)))
    ratios = [network["bound_ratio"] for network in networks]
    assert min(ratios) >= 1.0


def test_one_or_two_threads_the_same_bytes(run, tmp_path):
    study = STUDY + (ROBOT if "[robot]" in (run / "study.toml").read_text() else "")
    texts = set()
    for threads in ("1", "2"):
        folder = tmp_path / threads
        folder.mkdir()
        assert design(folder, study, "--threads", threads).returncode == 0
        texts.add((folder / "run" / "design.json").read_bytes())
    assert texts == {(run / "design.json").read_bytes()}


@pytest.mark.parametrize(
    ("old", "new", "status", "says"),
    [
        ("min_rays", "", 3, "robot"),
        ("max_incidence_deg", "max_incidence_deg = 2", 3, "no viewpoint sees"),
        ("too few", "min_rays = 3", 3, "max_images"),
    ],
    ids=["out of reach", "seen by nobody", "too few images"],
)
def test_infeasible_studies_are_one_line_and_status_3(tmp_path, old, new, status, says):
    study = STUDY
    if old == "min_rays":
        study += ROBOT.replace("-600, 0, 0", "-5000, 0, 0")
    elif old == "max_incidence_deg":
        study += f"[visibility]\n{new}\n"
    else:
        study = study.replace("max_images = 8", "max_images = 2")
    result = design(tmp_path, study)
    assert result.returncode == status, result.stderr
    lines = [line for line in result.stderr.splitlines() if line.startswith("netdesign:")]
    assert len(lines) == 1
    assert says in lines[0]
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "run").exists()


def test_a_run_folder_holds_one_study(run, tmp_path):
    study = tmp_path / "study.toml"
    study.write_text(STUDY.replace('"small"', '"other"'))
    before = (run / "design.json").read_bytes()
    command = [sys.executable, "-m", "netdesign", "design", str(study), "-o", str(run)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "another" in result.stderr
    assert (run / "design.json").read_bytes() == before


LONGER = STUDY.replace("population = 40\ngenerations = 10", "population = 100\ngenerations = 40000")


@pytest.mark.slow
def test_killed_ten_times_and_resumed_the_result_is_the_same(tmp_path):
    """SIGKILL at random moments, with one or two threads: the bytes of design.json do not change."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    assert design(whole, LONGER, "--threads", "1").returncode == 0
    path, run = killed / "study.toml", killed / "run"
    path.write_text(LONGER)
    rng, kills, resumed = np.random.default_rng(0), 0, 0
    for attempt in range(60):
        command = [sys.executable, "-m", "netdesign", "design", str(path), "-o", str(run), "--resume"]
        resumed += (run / "checkpoint.npz").is_file()
        process = subprocess.Popen([*command, "--threads", str(1 + attempt % 2)], stderr=subprocess.DEVNULL)
        until = time.monotonic() + 60
        while not (run / "study.toml").is_file() and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(rng.uniform(0.5, 5.0))
        process.kill()
        assert process.wait() in (0, -signal.SIGKILL)
        kills += process.returncode == -signal.SIGKILL
        if kills == 10:
            break
        if process.returncode == 0:  # a fast machine ends before it is killed: compare, and begin anew
            assert (run / "design.json").read_bytes() == (whole / "run" / "design.json").read_bytes()
            shutil.rmtree(run)
    assert kills == 10
    assert resumed >= 1
    result = design(killed, LONGER, "--resume", "--threads", "2")
    assert result.returncode == 0, result.stderr
    assert (run / "design.json").read_bytes() == (whole / "run" / "design.json").read_bytes()
    assert sorted(entry.name for entry in run.iterdir()) == ["design.json", "inputs", "study.toml"]


def test_a_termination_is_one_line_and_keeps_what_is_done(tmp_path):
    path, run = tmp_path / "study.toml", tmp_path / "run"
    path.write_text(LONGER.replace("generations = 40000", "generations = 100000"))
    command = [sys.executable, "-m", "netdesign", "design", str(path), "-o", str(run)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 100
    while not (run / "checkpoint.npz").is_file() and time.monotonic() < until:
        time.sleep(0.1)
    process.terminate()
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert said.splitlines()[-1] == "netdesign: interrupted, what is done is kept"
    assert "@" not in said  # no stack trace of glog's
    assert (run / "checkpoint.npz").is_file()
