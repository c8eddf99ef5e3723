"""Every command in README.md is run."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```sh\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)
COMMANDS = [line for block in BLOCKS for line in block.splitlines() if line.strip() and not line.startswith("#")]
MAKE = [command for command in COMMANDS if command.startswith("make ")]
OURS = [command for command in COMMANDS if command.startswith("netdesign ")]


def without_comment(command):
    return shlex.split(command, comments=True)


def environment():
    """Commands are found where this interpreter's are, as after the README's `export PATH`."""
    return {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}


def test_the_two_commands_of_a_bare_machine_come_first():
    assert MAKE[:2] == ["make demo", "make test"]


def test_every_command_is_one_we_know_how_to_test():
    others = [command for command in COMMANDS if command not in MAKE + OURS]
    assert all(command.startswith(("export PATH=", "python validation/run.py")) for command in others), others


@pytest.mark.parametrize("command", MAKE)
def test_make_targets_exist(command):
    target = without_comment(command)[1]
    done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_make_demo_runs_the_quick_study():
    plan = ["make", "--no-print-directory", "-n", "demo"]
    done = subprocess.run(plan, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.rstrip().endswith("netdesign run datasets/studies/quick.toml")


@pytest.mark.parametrize("command", OURS)
def test_commands_and_their_options_exist(command):
    words = without_comment(command)
    options = {word.split("=")[0] for word in words if word.startswith("-")} - {"--help"}
    if len(words) == 2:
        return
    done = subprocess.run(
        [sys.executable, "-m", "netdesign", words[1], "--help"],
        capture_output=True, text=True, check=False, env={**environment(), "COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    listed = set(re.findall(r"(?<![\w-])--?[\w-]+", done.stdout))
    assert options <= listed, options - listed


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if "://" not in target:
            assert (ROOT / target).exists(), target


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_the_tour_runs_from_its_first_command_to_its_last(tmp_path):
    """One after the other in an empty folder beside the datasets, as a reader would."""
    shutil.copytree(ROOT / "datasets", tmp_path / "datasets")
    for command in OURS:
        done = subprocess.run(
            without_comment(command), cwd=tmp_path, capture_output=True, text=True, check=False, env=environment()
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        assert done.stdout.strip(), command
    assert (tmp_path / "runs" / "quick" / "report.html").stat().st_size > 100_000
