"""Paths a study may name: beside it, absolute, or package:// inside the installed robot descriptions."""

import importlib.metadata
from pathlib import Path

from netdesign.errors import EnvironmentProblem

PACKAGE_SCHEME = "package://"
ROBOT_PACKAGE = "example-robot-data"


def resolve_path(name: str, folder: Path) -> Path:
    """Return the path of ``name``: package:// below the share folder of the robots, else relative to ``folder``."""
    if name.startswith(PACKAGE_SCHEME):
        return share_folder() / name.removeprefix(PACKAGE_SCHEME)
    return folder / name


def share_folder() -> Path:
    """Return the folder against which package://example-robot-data/… resolves.

    Raises:
        EnvironmentProblem: example-robot-data is not installed.
    """
    try:
        files = importlib.metadata.files(ROBOT_PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if f"share/{ROBOT_PACKAGE}/robots/" in file.as_posix():
            path = Path(str(file.locate())).resolve()
            return next(parent for parent in path.parents if parent.name == ROBOT_PACKAGE).parent
    raise EnvironmentProblem(f"the Python package {ROBOT_PACKAGE} is not installed; pip install {ROBOT_PACKAGE}")
