"""The run directory of a study: where it is, and that it holds one study only."""

from pathlib import Path

from netdesign.errors import InputError
from netdesign.files.study import ResolvedStudy, load_task, resolve, write_resolved
from netdesign.model.task import Task


def run_folder(resolved: ResolvedStudy, output: Path | None) -> Path:
    """Return the run directory, runs/<name> unless one is given.

    Raises:
        InputError: the folder holds the run of another study, or is a file.
    """
    run = output or Path("runs") / _folder_name(resolved.study.name)
    if run.exists() and not run.is_dir():
        raise InputError(f"{run}: expected a folder, found a file")
    study = run / "study.toml"
    if study.exists() and resolve(study).sha256 != resolved.sha256:
        raise InputError(f"{run}: holds the run of another study or seed; name another folder with -o, or remove it")
    return run


def _folder_name(name: str) -> str:
    """Return the study's name as that of one folder: it must not lead out of runs/."""
    return "run" if not name.strip(". ") else name.replace("/", "-").replace("\\", "-")


def belongs_to_validation(folder: Path) -> bool:
    """Whether ``folder`` is where ``validate`` keeps a network's results, to be read and renewed by it alone."""
    if (folder / "validation.json").is_file():
        return True
    above = folder.resolve().parents
    return any(parent.name == "networks" and (parent.parent / "study.toml").is_file() for parent in above[:2])


def open_run(run: Path) -> Task:
    """Return the task of an existing run directory.

    Raises:
        InputError: it is not one.
    """
    if not (run / "study.toml").is_file():
        raise InputError(f"{run}: expected a run directory, found no study.toml in it")
    return load_task(run / "study.toml")


def start_run(resolved: ResolvedStudy, run: Path) -> Task:
    """Write study.toml and inputs/, and return the task read back from there: what runs is what is kept."""
    return load_task(write_resolved(resolved, run))
