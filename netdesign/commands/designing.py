"""Commands around the search: a study goes in, a front and a choice come out."""

from pathlib import Path
from typing import Annotated

import typer

from netdesign.commands.options import JsonFlag, ResumeFlag, RunFolder, RunOption, SeedOption, StudyFile, WorkersOption
from netdesign.console import as_json as _json
from netdesign.console import conclude as _conclude
from netdesign.console import progress as _progress
from netdesign.console import show as _print
from netdesign.console import workers as _workers
from netdesign.errors import InputError


def run(
    study: StudyFile,
    output: RunOption = None,
    seed: SeedOption = None,
    resume: ResumeFlag = False,
    workers: WorkersOption = 0,
) -> None:
    """Design, validate every network of the front, write the report: the main job."""
    from netdesign.main_job import run_study

    with _progress() as progress:
        outcome = run_study(study, output, seed=seed, resume=resume, workers=_workers(workers), progress=progress)
    _conclude(outcome.summary, outcome.unmet)


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder to create", show_default=False)],
    template: Annotated[str, typer.Option(help="shipped study to copy, a name of datasets/studies")] = "quick",
) -> None:
    """Write a starter study that runs as it is."""
    from netdesign.starter import write_starter

    _print(f"netdesign run {write_starter(folder, template)}")


def check(study: StudyFile, as_json: JsonFlag = False) -> None:
    """Read and resolve a study; say what can be seen and reached from where, and what is infeasible and why."""
    from netdesign.check import check_study

    with _progress() as progress:
        findings = check_study(study, progress)
    _print(_json(findings.record) if as_json else findings.text)
    if findings.problem is not None:
        raise findings.problem


def design(
    study: StudyFile,
    output: RunOption = None,
    seed: SeedOption = None,
    resume: ResumeFlag = False,
    threads: Annotated[int, typer.Option(help="threads of the kernels; 0: one per core", min=0)] = 0,
) -> None:
    """Search the Pareto front of camera networks; write RUN/design.json."""
    from netdesign.design import design_study

    with _progress() as progress:
        outcome = design_study(study, output, seed=seed, resume=resume, threads=_workers(threads), progress=progress)
    _conclude(outcome.summary, outcome.unmet)


def front(
    run: RunFolder,
    as_json: JsonFlag = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="print the result as CSV")] = False,
) -> None:
    """Print the Pareto front as a table."""
    from netdesign.choose import front as read_front
    from netdesign.terminal import csv_table, text_table

    if as_json and as_csv:
        raise InputError("--json, --csv: expected one of them, found both")
    rows = read_front(run)
    _print(_json(rows) if as_json else (csv_table(rows) if as_csv else text_table(rows)))


def choose(
    run: RunFolder,
    knee: Annotated[bool, typer.Option("--knee", help="the best compromise of the front")] = False,
    max_sigma_um: Annotated[float | None, typer.Option(help="largest standard deviation of a point")] = None,
    max_images: Annotated[int | None, typer.Option(help="most images")] = None,
    max_tour: Annotated[float | None, typer.Option(help="longest tour, in the unit of f2")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Pick one network of the front and say why."""
    from netdesign.choose import choose as choose_network

    choice = choose_network(run, knee=knee, max_sigma_um=max_sigma_um, max_images=max_images, max_tour=max_tour)
    _print(_json(choice.record) if as_json else choice.text)


def repair(
    study: StudyFile,
    stations: Annotated[
        str | None, typer.Option(help="design.json#ID, CSV or images.txt; default: the study's existing")
    ] = None,
    add: Annotated[int, typer.Option(help="images to add, one after the other", min=0, max=60)] = 1,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="CSV to write: the stations, added ones last")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Say what each image of a given network is worth and which to add next."""
    from netdesign.repair import repair_study

    with _progress() as progress:
        found = repair_study(study, stations, add, output, progress)
    _print(_json(found.record) if as_json else found.text)
