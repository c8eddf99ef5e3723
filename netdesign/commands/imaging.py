"""Commands that make pictures or live on them."""

from pathlib import Path
from typing import Annotated

import typer

from netdesign.commands.options import RendererOption, RunFolder, StudyFile, WorkersOption
from netdesign.console import progress as _progress
from netdesign.console import show as _print
from netdesign.console import workers as _workers


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


def calibrate_noise(
    study: StudyFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write")] = Path("noise.json"),
) -> None:
    """Measure the detector on a rendered grid; write the file that noise = "detector" uses."""
    from netdesign.calibrate import calibrate_study

    with _progress() as progress:
        _print(calibrate_study(study, output, progress))
