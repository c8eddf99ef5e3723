"""The command line: parses, calls a verb, prints its result; heavy imports wait until a verb is called."""

import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from netdesign.console import as_json as _json
from netdesign.console import conclude as _conclude
from netdesign.console import progress as _progress
from netdesign.console import show as _print
from netdesign.console import words as _words
from netdesign.console import workers as _workers
from netdesign.errors import InputError, NetdesignError
from netdesign.interruption import end_cleanly

# Typer brings its own click along, or takes the installed one: the class is found from what it exports.
CommandProblem = cast(type[Exception], typer.BadParameter.__mro__[2])

app = typer.Typer(
    name="netdesign",
    help="Design camera networks for automated visual inspection, and prove them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

StudyFile = Annotated[Path, typer.Argument(help="study file (TOML)", show_default=False)]
RunFolder = Annotated[Path, typer.Argument(help="run directory written by design or run", show_default=False)]
RunOption = Annotated[Path | None, typer.Option("-o", "--output", help="run directory; default runs/<name>")]
SeedOption = Annotated[int | None, typer.Option(help="instead of the study's seed", min=0)]
JsonFlag = Annotated[bool, typer.Option("--json", help="print the result as JSON")]
ResumeFlag = Annotated[bool, typer.Option("--resume", help="go on with an unfinished search")]
WorkersOption = Annotated[int, typer.Option(help="processes; 0: one per core", min=0)]
RendererOption = Annotated[Literal["pyrender", "reference"], typer.Option(help="reference: own ray caster, no EGL")]


@app.command()
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


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder to create", show_default=False)],
    template: Annotated[str, typer.Option(help="shipped study to copy, a name of datasets/studies")] = "quick",
) -> None:
    """Write a starter study that runs as it is."""
    from netdesign.starter import write_starter

    _print(f"netdesign run {write_starter(folder, template)}")


@app.command()
def check(study: StudyFile, as_json: JsonFlag = False) -> None:
    """Read and resolve a study; say what can be seen and reached from where, and what is infeasible and why."""
    from netdesign.check import check_study

    with _progress() as progress:
        findings = check_study(study, progress)
    _print(_json(findings.record) if as_json else findings.text)
    if findings.problem is not None:
        raise findings.problem


@app.command()
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


@app.command()
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


@app.command()
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


@app.command()
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


@app.command()
def images(
    run: RunFolder,
    network: Annotated[int, typer.Option(help="id of the network", min=0)],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write")],
    workers: WorkersOption = 0,
    renderer: RendererOption = "pyrender",
) -> None:
    """Render the synthetic image set of one network, with ground truth."""
    from netdesign.validate import render_network

    with _progress() as progress:
        count = render_network(run, network, output, _workers(workers), renderer, progress)
    _print(f"{output}: {count} images, COLMAP model, truth.json")


@app.command()
def validate(
    run: RunFolder,
    network: Annotated[list[int] | None, typer.Option(help="id of a network; repeat for more; default all")] = None,
    workers: WorkersOption = 0,
    dask: Annotated[str | None, typer.Option(help="address of a dask scheduler")] = None,
) -> None:
    """Render, detect, adjust and compare networks of the front; resumes by itself."""
    from netdesign.validate import validate_run

    with _progress() as progress:
        outcome = validate_run(run, network, workers=_workers(workers), dask=dask, progress=progress)
    _print(outcome.summary)


@app.command()
def dataset(
    recipe: Annotated[Path, typer.Argument(help="recipe (TOML) as in datasets/", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write")],
    workers: WorkersOption = 0,
    renderer: RendererOption = "pyrender",
) -> None:
    """Write a free-standing synthetic image set from a recipe."""
    from netdesign.dataset import render_dataset

    with _progress() as progress:
        made = render_dataset(recipe, output, workers=_workers(workers), renderer=renderer, progress=progress)
    _print(f"{output}: {made.text}")


@app.command("calibrate-noise")
def calibrate_noise(
    study: StudyFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write")] = Path("noise.json"),
) -> None:
    """Measure the detector on a rendered grid; write the file that noise = "detector" uses."""
    from netdesign.calibrate import calibrate_study

    with _progress() as progress:
        _print(calibrate_study(study, output, progress))


@app.command()
def adjust(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="image set or observation set", show_default=False)],
    sigma_px: Annotated[float | None, typer.Option(help="image-coordinate noise; default: the set's own")] = None,
    datum: Annotated[
        Literal["free", "fixed", "control", "scale", "poses"] | None,
        typer.Option(help="what fixes the frame; default: what the set brings, else free"),
    ] = None,
    datum_points: Annotated[str | None, typer.Option(help="a,b,c…: points of the inner constraints")] = None,
    control: Annotated[Path | None, typer.Option(help="CSV: point,x_mm,y_mm,z_mm,sigma_mm")] = None,
    scale_bars: Annotated[Path | None, typer.Option(help="CSV: a,b,length_mm,sigma_mm")] = None,
    poses: Annotated[Path | None, typer.Option(help="CSV: image,sigma_position_mm,sigma_rotation_deg[,pose]")] = None,
    refine: Annotated[str | None, typer.Option(help="any of f,fx,fy,cx,cy,k1,k2,p1,p2")] = None,
    robust: Annotated[bool, typer.Option("--robust", help="find and reject gross errors")] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="folder for the result; default: DIR")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Bundle adjustment of an image set or an observation set, real or synthetic."""
    from netdesign.adjust import adjust_folder

    with _progress() as progress:
        outcome = adjust_folder(
            folder,
            sigma_px=sigma_px,
            datum=datum,
            datum_points=_words(datum_points),
            control=control,
            scale_bars=scale_bars,
            poses=poses,
            refine=_words(refine),
            robust=robust,
            out=output,
            progress=progress,
        )
    _print(_json(outcome.record) if as_json else outcome.text)


@app.command()
def report(run: RunFolder) -> None:
    """Write RUN/report.html, one self-contained file."""
    from netdesign.report import write_report

    _print(str(write_report(run)))


@app.command()
def export(
    run: RunFolder,
    network: Annotated[int, typer.Option(help="id of the network", min=0)],
    format: Annotated[Literal["json", "csv", "colmap", "urscript", "ros2", "glb"], typer.Option(help="what to write")],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write; a folder for colmap")],
) -> None:
    """Write one network for other programs."""
    from netdesign.export import export as export_network

    _print(str(export_network(run, network, format, output)))


@app.command()
def doctor(as_json: JsonFlag = False) -> None:
    """Test the installation: EGL render, conventions, versions; say what to install."""
    from netdesign.doctor import doctor as examine

    findings = examine()
    _print(_json(findings.record) if as_json else findings.text)
    if findings.problem is not None:
        raise findings.problem


def main() -> None:
    """Run the command line and leave with the exit status of the contract."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait for each other
    end_cleanly()
    try:
        if app(standalone_mode=False) == 130:  # what Typer makes of a KeyboardInterrupt
            raise KeyboardInterrupt
    except CommandProblem as problem:
        error: Any = problem
        message = " ".join(str(error.format_message()).split())
        if type(problem).__name__ == "NoArgsIsHelpError":
            _complain(str(error.message), 2)
        context = getattr(problem, "ctx", None)
        _complain(f"{context.command_path if context else 'netdesign'}: {message}", 2)
    except NetdesignError as refusal:
        _complain(f"netdesign: {refusal}", refusal.exit_status)
    except (KeyboardInterrupt, typer.Abort):
        _complain("netdesign: interrupted, what is done is kept", 130)
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(line: str, status: int) -> None:
    sys.stderr.write(line.rstrip() + "\n")
    sys.exit(status)
