"""The structure of the package, read from the syntax trees: one-way imports, one place for each foreign library."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "netdesign"
FILES = sorted(PACKAGE.rglob("*.py"))
IDS = [str(path.relative_to(ROOT)) for path in FILES]

# Folders by layer; modules directly below netdesign/ are verbs (5), the command line is above them (6).
LAYERS = {
    "model": 1, "errors": 1, "photogrammetry": 2, "motion": 3, "search": 3, "imaging": 3, "adjustment": 3,
    "placement": 4, "files": 4, "reporting": 4, "cli": 6, "commands": 6, "console": 6, "__main__": 6, "__init__": 0,
}  # fmt: skip
VERB = 5

# Where a foreign library may be met; numpy, scipy and numba are at home everywhere.
QUARANTINE = {
    "pinocchio": ["motion/robot.py"],
    "coal": ["motion/"],
    "pyrender": ["imaging/render.py"],
    "OpenGL": ["imaging/render.py"],
    "pyglet": ["imaging/render.py"],
    "cv2": ["imaging/detect.py", "imaging/tags.py", "imaging/pictures.py"],
    "gtsam": ["adjustment/bundle.py"],
    "pycolmap": ["files/colmap.py"],
    "pydantic": ["model/study.py", "files/", "imageset.py"],
    "tomli_w": ["files/"],
    "trimesh": ["files/", "reporting/", "export.py"],
    "moocore": ["search/", "placement/"],
    "typer": ["cli.py", "commands/"],
    "rich": ["terminal.py"],
    "matplotlib": ["reporting/"],
    "plotly": ["reporting/"],
    "jinja2": ["reporting/"],
    "markupsafe": ["reporting/"],
    "PIL": ["reporting/"],
    "distributed": ["cluster.py"],
    "threadpoolctl": ["model/blas.py"],
}
EVERYWHERE = {"numpy", "scipy", "numba"}
LONGEST = 300
DEFINITIONS = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.AnnAssign)
UNWANTED_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "tools"}


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(path: Path) -> set[str]:
    """Dotted names of everything a file imports, also inside functions and for type checking only."""
    names: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def folder_of(path: Path) -> str:
    """The folder below netdesign/, or the module's own name for a file directly in it."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


def imported_folders(path: Path) -> set[str]:
    """Folders and top modules of netdesign that a file imports from."""
    return {name.split(".")[1] for name in imported(path) if name.startswith("netdesign.")} - {"__version__"}


def test_there_is_something_to_look_at():
    assert len(FILES) > 30


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_imports_point_one_way(path):
    own = folder_of(path)
    layer = LAYERS.get(own, VERB)
    for other in imported_folders(path) - {own}:
        below = LAYERS.get(other, VERB)
        assert below < layer or (layer == below == VERB) or (layer == below == 6), f"{path} imports {other}"


def test_search_knows_nothing_of_cameras():
    for path in sorted((PACKAGE / "search").glob("*.py")):
        assert imported_folders(path) <= {"search", "errors"}, path


def test_verbs_do_not_call_one_another_in_circles():
    verbs = {path.stem: path for path in PACKAGE.glob("*.py") if LAYERS.get(path.stem, VERB) == VERB}
    calls = {name: imported_folders(path) & set(verbs) - {name} for name, path in verbs.items()}
    while calls:
        leaves = {name for name, called in calls.items() if not called & set(calls)}
        assert leaves, f"a circle among {sorted(calls)}"
        calls = {name: called for name, called in calls.items() if name not in leaves}


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_a_foreign_library_is_met_in_one_place(path):
    place = path.relative_to(PACKAGE).as_posix()
    for name in {name.split(".")[0] for name in imported(path)} & set(QUARANTINE):
        assert any(place.startswith(allowed) for allowed in QUARANTINE[name]), f"{place} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_files_are_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_nothing_happens_at_import(path):
    """Only definitions at module level: no call whose result is thrown away, no write into something imported."""
    if path.name == "__main__.py":
        return
    for node in tree_of(path).body:
        where = f"{path}:{node.lineno}"
        if isinstance(node, ast.Expr):
            assert isinstance(node.value, ast.Constant), f"{where}: a statement that does something at import"
        elif isinstance(node, ast.If):
            condition = ast.unparse(node.test)
            assert condition in {"TYPE_CHECKING", "__name__ == '__main__'"}, f"{where}: if {condition}"
        elif isinstance(node, ast.Assign):
            assert all(isinstance(target, ast.Name | ast.Tuple) for target in node.targets), f"{where}: writes away"
        else:
            assert isinstance(node, DEFINITIONS), f"{where}: {type(node).__name__}"


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_errors_are_named_and_results_returned(path):
    """No `except Exception` that goes on, no assert that checks input; only the command line prints."""
    speaks = path.name in {"cli.py", "console.py", "terminal.py"}
    for node in ast.walk(tree_of(path)):
        where = f"{path}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.ExceptHandler):
            caught = "" if node.type is None else ast.unparse(node.type)
            clears_up = isinstance(node.body[-1], ast.Raise) and node.body[-1].exc is None
            assert caught not in {"", "Exception", "BaseException"} or clears_up, f"{where}: except {caught}"
        if isinstance(node, ast.Assert):
            narrows = ast.unparse(node.test).endswith(" is not None") and node.msg is None
            assert narrows, f"{where}: assert is for tests, and for what mypy must be told"
        if isinstance(node, ast.Name):
            assert node.id != "print", f"{where}: print"
        if isinstance(node, ast.Attribute) and not speaks:
            assert ast.unparse(node) not in {"sys.stdout", "sys.stderr"}, f"{where}: {ast.unparse(node)}"


def test_no_module_without_a_subject():
    assert not [path for path in FILES if path.stem in UNWANTED_NAMES or path.parent.name in UNWANTED_NAMES]


def test_every_module_says_what_it_is():
    assert not [path for path in FILES if not ast.get_docstring(tree_of(path))]


def test_every_quarantined_library_is_used_and_every_used_library_is_quarantined():
    """A new dependency needs a line here, and with it a thought about where it belongs."""
    used = {name.split(".")[0] for path in FILES for name in imported(path)}
    foreign = used - set(sys.stdlib_module_names) - {"netdesign"} - EVERYWHERE
    assert foreign <= set(QUARANTINE), foreign - set(QUARANTINE)
