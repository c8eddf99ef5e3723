"""``netdesign new``: a study of one's own to start from, copied with its inputs from the ones that are shipped."""

import sys
from pathlib import Path

from netdesign.errors import EnvironmentProblem, InputError
from netdesign.files.packages import PACKAGE_SCHEME
from netdesign.files.store import write_bytes, write_text
from netdesign.files.study import load_task
from netdesign.files.study_text import read_toml

# Where a study names a file of its own, and the file's name in the new folder.
INPUTS = {("part", "mesh"): "part", ("targets", "file"): "targets", ("camera", "file"): "camera"}


def write_starter(folder: Path, template: str) -> Path:
    """Write study.toml and inputs/ into a new folder and return the study's path.

    Raises:
        InputError: no such template, or the folder exists and is not empty.
        EnvironmentProblem: the shipped studies are not where an installation puts them.
    """
    studies = _datasets() / "studies"
    known = sorted(path.stem for path in studies.glob("*.toml"))
    if template not in known:
        raise InputError(f"--template: expected one of {', '.join(known)}, found {template!r}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected a folder that is new or empty")
    source = studies / f"{template}.toml"
    load_task(source)  # a broken template must not be copied
    content, text = read_toml(source), source.read_text(encoding="utf-8")
    for (table, key), stem in INPUTS.items():
        name = content[table].get(key)
        if name is not None and not name.startswith(PACKAGE_SCHEME):
            copy = f"inputs/{stem}{Path(name).suffix}"
            write_bytes(folder / copy, (source.parent / name).read_bytes())
            text = text.replace(f'"{name}"', f'"{copy}"')
    write_text(folder / "study.toml", text)
    return folder / "study.toml"


def _datasets() -> Path:
    """Return datasets/ of the source tree, or where an installed package keeps it."""
    places = [Path(__file__).parents[1] / "datasets", Path(sys.prefix) / "share" / "netdesign" / "datasets"]
    for place in places:
        if (place / "studies").is_dir():
            return place
    raise EnvironmentProblem("the shipped studies are missing (share/netdesign/datasets); reinstall netdesign")
