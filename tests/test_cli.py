"""The command line: one clear line and the exit status of the contract."""

import subprocess
import sys

import pytest


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
