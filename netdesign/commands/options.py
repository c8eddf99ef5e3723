"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated, Literal

import typer

StudyFile = Annotated[Path, typer.Argument(help="study file (TOML)", show_default=False)]
RunFolder = Annotated[Path, typer.Argument(help="run directory written by design or run", show_default=False)]
RunOption = Annotated[Path | None, typer.Option("-o", "--output", help="run directory; default runs/<name>")]
SeedOption = Annotated[int | None, typer.Option(help="instead of the study's seed", min=0)]
JsonFlag = Annotated[bool, typer.Option("--json", help="print the result as JSON")]
ResumeFlag = Annotated[bool, typer.Option("--resume", help="go on with an unfinished search")]
WorkersOption = Annotated[int, typer.Option(help="processes; 0: one per core", min=0)]
RendererOption = Annotated[Literal["pyrender", "reference"], typer.Option(help="reference: own ray caster, no EGL")]
