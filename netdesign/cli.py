"""The command line: its commands in the order of ``--help``, and how it ends."""

import os
import sys
from typing import Any, cast

import typer

from netdesign.commands import designing, imaging, results
from netdesign.environment import prepare_environment
from netdesign.errors import NetdesignError
from netdesign.interruption import end_cleanly

# Typer brings its own click along, or takes the installed one: the class is found from what it exports.
CommandProblem = cast(type[Exception], typer.BadParameter.__mro__[2])

COMMANDS = (
    designing.run, designing.new, designing.check, designing.design, designing.front, designing.choose,
    designing.repair,
    imaging.images, imaging.validate, imaging.dataset, imaging.calibrate_noise,
    results.adjust, results.report, results.export, results.doctor,
)  # fmt: skip


def application() -> typer.Typer:
    """Return the command line with all its commands."""
    found = typer.Typer(
        name="netdesign",
        help="Design camera networks for automated visual inspection, and prove them.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    for command in COMMANDS:
        found.command(command.__name__.replace("_", "-"))(command)
    return found


app = application()


def main() -> None:
    """Run the command line and leave with the exit status of the contract."""
    prepare_environment()
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
    except OSError as problem:
        if isinstance(problem, BrokenPipeError):  # the reader of our output has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return
        if problem.filename is None:  # no file that a user could have named
            raise
        place = problem.filename2 or problem.filename
        _complain(f"netdesign: {place}: cannot be read or written: {problem.strerror}", 2)


def _complain(line: str, status: int) -> None:
    sys.stderr.write(line.rstrip() + "\n")
    sys.exit(status)
