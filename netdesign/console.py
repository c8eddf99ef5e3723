"""What the commands share: results on stdout, JSON, lists of words, progress; imports nothing heavy."""

import json
import os
import sys
from typing import TYPE_CHECKING, Any

from netdesign.errors import InfeasibleError

if TYPE_CHECKING:
    from netdesign.terminal import TerminalProgress


def show(text: str) -> None:
    """Write a result to stdout."""
    sys.stdout.write(text.rstrip("\n") + "\n")
    sys.stdout.flush()


def conclude(summary: str, unmet: str | None) -> None:
    """Show what was done and written; then a script must learn that no network keeps the requirements.

    Raises:
        InfeasibleError: ``unmet`` says why none does.
    """
    show(summary)
    if unmet is not None:
        raise InfeasibleError(f"requirements: {unmet}")


def as_json(value: Any) -> str:
    """Return what ``--json`` prints."""
    from netdesign.files.store import plain

    return json.dumps(plain(value), sort_keys=True, indent=1, ensure_ascii=False)


def words(text: str | None) -> tuple[str, ...]:
    """Return the words of a comma-separated list."""
    return tuple(word.strip() for word in (text or "").split(",") if word.strip())


def workers(count: int) -> int:
    """Return the number of processes, one per core for 0."""
    return count or len(os.sched_getaffinity(0))


def progress() -> "TerminalProgress":
    """Return the progress display of a command."""
    from netdesign.terminal import TerminalProgress

    return TerminalProgress()
