"""What an installation from this repository relies on: declared, locked by hash, and free of addresses."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCK = (ROOT / "constraints.txt").read_text(encoding="utf-8")
LOCKED = dict(re.findall(r"^([a-z0-9.-]+)==([^ ;\\]+)", LOCK, flags=re.MULTILINE))


def canonical(requirement):
    """Name of a requirement as lock files spell it, and its lower bound."""
    name, bound = re.fullmatch(r"([A-Za-z0-9._-]+)>=([0-9.]+)", requirement).groups()
    return re.sub(r"[-_.]+", "-", name).lower(), bound


def numbers(version):
    return tuple(int(part) for part in re.findall(r"\d+", version.split("post")[0]))


def declared():
    extras = [requirement for extra in PROJECT["optional-dependencies"].values() for requirement in extra]
    return [*PROJECT["dependencies"], *extras]


@pytest.mark.parametrize("requirement", declared())
def test_every_declared_dependency_is_locked_above_its_bound(requirement):
    name, bound = canonical(requirement)
    assert name in LOCKED
    assert numbers(LOCKED[name]) >= numbers(bound)


def test_every_locked_version_has_hashes():
    blocks = re.split(r"\n(?=[a-z])", LOCK.strip())
    assert len(blocks) == len(LOCKED) > 60
    for block in blocks:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), block.splitlines()[0]


def test_the_lock_names_no_place():
    """No index, no address, no file: whoever installs uses the index that is set up there."""
    for word in ("://", "index", "find-links", "file:", " @ ", "/work", "/opt", "/home"):
        assert word not in LOCK, word


def test_every_import_of_the_package_is_declared():
    owners = packages_distributions()
    names = {canonical(requirement)[0] for requirement in PROJECT["dependencies"]}
    optional = {canonical(requirement)[0] for requirement in PROJECT["optional-dependencies"]["dask"]}
    # Come with what is declared: pin is pinocchio and its collision library, pyrender brings OpenGL.
    carried = {"pinocchio", "coal", "OpenGL", "pyglet"}
    for path in sorted((ROOT / "netdesign").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for module in {name.split(".")[0] for name in modules} - set(sys.stdlib_module_names) - {"netdesign"}:
                owner = {re.sub(r"[-_.]+", "-", name).lower() for name in owners.get(module, [])}
                assert module in carried or owner & (names | optional), f"{path}: {module} is not declared"


def test_no_machine_path_in_the_repository():
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    place = re.compile(r"(?<![\w.])/(work|root|home)/\w")
    for path in (ROOT / name for name in done.stdout.splitlines()):
        if path.suffix in {".py", ".toml", ".md", ".txt", ".yaml", ".cfg", ""} and path.is_file():
            found = place.search(path.read_text(encoding="utf-8", errors="replace"))
            assert found is None or path == Path(__file__), f"{path}: {found}"


def test_make_knows_what_it_would_do():
    """Every documented target exists; nothing is run."""
    for target in ("demo", "test", "slowtest", "quicktest", "lint"):
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_the_wheel_carries_its_data():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    carried = {
        path
        for pattern in patterns["package-data"]["netdesign"]
        for path in (ROOT / "netdesign").glob(pattern)
        if path.is_file()
    }
    data = {
        path
        for path in (ROOT / "netdesign").rglob("*")
        if path.is_file() and path.suffix not in {".py", ".pyc", ".nbi", ".nbc"}
    }
    assert data == carried
