"""What the command line shows: a progress bar or plain lines on stderr, and tables for stdout."""

import csv
import io
import sys
import time
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from netdesign.model.figures import significant

SECONDS_BETWEEN_LINES = 5.0
QUIET_SECONDS = 2.0  # a command that ends sooner needs no progress: bad input is one line and nothing else


class TerminalProgress:
    """A bar with the remaining time on a terminal; elsewhere a line per stage and every few seconds."""

    def __init__(self) -> None:
        """Prepare; nothing is shown before the first call."""
        self._console = Console(stderr=True)
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._begin = self._last_line = time.monotonic()
        self._last_stage = ""

    def __enter__(self) -> "TerminalProgress":
        if self._console.is_terminal:
            self._bars = Progress(
                TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"), console=self._console,
            )  # fmt: skip
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show that ``done`` of ``total`` steps of ``stage`` are finished."""
        if self._bars is not None:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(stage, total=total, note=note)
            self._bars.update(self._tasks[stage], completed=done, total=total, note=note)
            return
        now = time.monotonic()
        if now - self._begin < QUIET_SECONDS:
            return
        if stage != self._last_stage or done >= total or now - self._last_line >= SECONDS_BETWEEN_LINES:
            self._last_stage, self._last_line = stage, now
            sys.stderr.write(f"{stage} {done}/{total}{'  ' + note if note else ''}\n")


def text_table(rows: list[dict[str, Any]]) -> str:
    """Return rows with the same keys as aligned columns; numbers to the right."""
    if not rows:
        return "(empty)"
    columns = list(rows[0])
    cells = [[_cell(row[column]) for column in columns] for row in rows]
    widths = [max(len(name), *(len(row[index]) for row in cells)) for index, name in enumerate(columns)]
    right = [all(not isinstance(row[column], str) for row in rows) for column in columns]

    def line(words: list[str]) -> str:
        pairs = zip(words, widths, right, strict=True)
        return "  ".join(word.rjust(width) if number else word.ljust(width) for word, width, number in pairs).rstrip()

    return "\n".join([line(columns), line(["-" * width for width in widths]), *(line(row) for row in cells)])


def csv_table(rows: list[dict[str, Any]]) -> str:
    """Return rows with the same keys as CSV with a header."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return significant(value) if isinstance(value, float) else str(value)
