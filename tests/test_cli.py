"""The command line: one clear line and the exit status of the contract."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from netdesign.choose import front
from netdesign.environment import prepare_environment
from netdesign.errors import InputError
from netdesign.export import export
from netdesign.files.design_json import find_network
from netdesign.files.stations import stations_table
from netdesign.run_folder import open_run
from tests.runs import ring_run


def netdesign(*arguments, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "netdesign", *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nonsense"], "No such command"),
        (["run"], "Missing argument"),
        (["run", "none.toml"], "none.toml: no such file"),
        (["front", "."], "design.json"),
        (["images", ".", "--network", "-1", "-o", "x"], "--network"),
        (["adjust", ".", "--datum", "wrong"], "--datum"),
        (["adjust", "."], "expected"),
        (["new", "x", "--template", "wrong"], "--template: expected one of"),
        (["report", "."], "expected"),
        (["validate", "."], "run directory"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(tmp_path, arguments, says):
    result = netdesign(*arguments, cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert says in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    result = netdesign("new", tmp_path / "file" / "study")
    assert result.returncode == 2
    assert result.stderr.startswith(f"netdesign: {tmp_path / 'file'}")
    assert result.stderr.endswith(": cannot be read or written: Not a directory\n")
    assert result.stderr.count("\n") == 1
    assert (tmp_path / "file").read_text() == "mine"


def test_exports_neither_replace_folders_nor_write_into_files(tmp_path):
    ring_run(tmp_path / "run", sizes=(8,))
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="expected a file for csv, found a folder"):
        export(tmp_path / "run", 0, "csv", tmp_path)
    with pytest.raises(InputError, match="expected a folder for colmap, found a file"):
        export(tmp_path / "run", 0, "colmap", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("writable", [True, False])
def test_kernels_are_kept_somewhere_even_where_nothing_can_be_written(monkeypatch, writable):
    monkeypatch.setattr("netdesign.environment.os.access", lambda place, mode: writable)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    prepare_environment()
    chosen = os.environ.pop("NUMBA_CACHE_DIR", None)
    assert (chosen is None) == writable
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/mine")
    prepare_environment()
    assert os.environ["NUMBA_CACHE_DIR"] == "/mine"


COMMANDS = (
    "run new check design front choose images validate dataset calibrate-noise adjust report export doctor"
).split()


def test_help_names_every_command():
    result = netdesign("--help")
    assert result.returncode == 0
    for command in COMMANDS:
        assert f"\n  {command}" in result.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_loads_no_heavy_library(command):
    code = (
        "import sys; sys.argv = ['netdesign', sys.argv[1], '--help']\n"
        "from netdesign.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'numba', 'gtsam', 'cv2', 'pycolmap', 'pinocchio', 'pyrender', 'plotly'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code, command], check=True, capture_output=True)


def test_the_glb_of_a_study_without_a_robot_holds_part_and_stations(tmp_path):
    ring_run(tmp_path / "run")
    path = export(tmp_path / "run", 0, "glb", tmp_path / "cell.glb")
    scene = trimesh.load(path)
    task, network = open_run(tmp_path / "run"), find_network(tmp_path / "run", 0)
    assert sorted(scene.geometry) == sorted(["part", *(f"station_{i}" for i in range(len(network.viewpoints)))])
    x, y, z = task.scene.part.vertices.T  # z up becomes glTF's y up
    np.testing.assert_allclose(scene.geometry["part"].bounds[1], [x.max(), z.max(), -y.min()], atol=1e-6)
    with pytest.raises(InputError, match=r"urscript: expected a study with a \[robot\] table"):
        export(tmp_path / "run", 0, "urscript", tmp_path / "program.script")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda d: d.pop("networks"), "expected at least one network, found none"),
        (lambda d: d["networks"][1].pop("world_from_cam_mm"), r"networks\[1\]: .* found no world_from_cam_mm"),
        (lambda d: d["networks"][0].update(world_from_cam_mm="x"), r"networks\[0\]: expected n poses 4x4"),
        (lambda d: d["networks"][0]["viewpoints_deg"].pop(), r"networks\[0\]: expected n poses 4x4"),
    ],
)
def test_a_design_json_that_is_not_whole_is_one_line(tmp_path, spoil, says):
    ring_run(tmp_path / "run")
    path = tmp_path / "run/design.json"
    content = json.loads(path.read_text())
    spoil(content)
    path.write_text(json.dumps(content))
    for read in (
        lambda: export(tmp_path / "run", 0, "csv", tmp_path / "out.csv"),
        lambda: stations_table(f"{path}#0", tmp_path),
        lambda: front(tmp_path / "run"),
    ):
        with pytest.raises(InputError, match=says):
            read()
