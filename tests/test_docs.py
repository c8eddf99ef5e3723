"""Every command of docs/adjust.md is run, and says what the page says."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from netdesign.cli import app

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "adjust.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```sh\n(.*?)^```\n```text\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)


def test_the_page_has_examples_and_no_command_without_its_output():
    assert len(EXAMPLES) == PAGE.count("```sh") >= 3


@pytest.mark.parametrize(("command", "shown"), EXAMPLES)
def test_commands_say_what_the_page_says(tmp_path, monkeypatch, command, shown):
    shutil.copytree(ROOT / "datasets" / "observations", tmp_path / "datasets" / "observations")
    monkeypatch.chdir(tmp_path)
    words = shlex.split(command)
    assert words[0] == "netdesign"
    done = CliRunner().invoke(app, words[1:])
    assert done.exit_code == 0, done.output
    printed = [_without_iterations(line) for line in done.stdout.splitlines()]
    for line in shown.splitlines():
        assert _without_iterations(line) in printed


def _without_iterations(line):
    """Another processor rounds otherwise and may need one more."""
    return re.sub(r", \d+ iterations$", "", line)


def test_the_shipped_observation_set_is_what_its_script_writes(tmp_path):
    folder = ROOT / "datasets" / "observations"
    subprocess.run([sys.executable, folder / "make_observations.py", tmp_path], check=True, cwd=ROOT)
    names = sorted(path.name for path in (folder / "gauge").iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name in names:
        assert (tmp_path / name).read_bytes() == (folder / "gauge" / name).read_bytes()
