"""Commands that adjust, report, export, and test the installation."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from netdesign.commands.options import JsonFlag, RunFolder
from netdesign.console import as_json as _json
from netdesign.console import progress as _progress
from netdesign.console import show as _print
from netdesign.console import words as _words


def adjust(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="image set or observation set", show_default=False)],
    sigma_px: Annotated[float | None, typer.Option(help="image-coordinate noise; default: the set's own")] = None,
    datum: Annotated[
        Literal["free", "fixed", "control", "scale", "poses"] | None,
        typer.Option(help="what fixes the frame; default: what the set brings, else free"),
    ] = None,
    datum_points: Annotated[str | None, typer.Option(help="a,b,c…: points of the inner constraints")] = None,
    control: Annotated[
        Path | None, typer.Option(help="CSV: point,x_mm,y_mm,z_mm,sigma_mm or sx_mm,sy_mm,sz_mm")
    ] = None,
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


def report(run: RunFolder) -> None:
    """Write RUN/report.html, one self-contained file."""
    from netdesign.report import write_report

    _print(str(write_report(run)))


def export(
    run: RunFolder,
    network: Annotated[int, typer.Option(help="id of the network", min=0)],
    format: Annotated[Literal["json", "csv", "colmap", "urscript", "ros2", "glb"], typer.Option(help="what to write")],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write; a folder for colmap")],
) -> None:
    """Write one network for other programs."""
    from netdesign.export import export as export_network

    _print(str(export_network(run, network, format, output)))


def doctor(as_json: JsonFlag = False) -> None:
    """Test the installation: EGL render, conventions, versions; say what to install."""
    from netdesign.doctor import doctor as examine

    findings = examine()
    _print(_json(findings.record) if as_json else findings.text)
    if findings.problem is not None:
        raise findings.problem
