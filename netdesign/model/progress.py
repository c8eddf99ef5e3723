"""How long work says how far it is: one function, passed down; nobody below the command line prints."""

from typing import Protocol


class Progress(Protocol):
    """Called with the stage, what is done of how much, and a short note such as the hypervolume."""

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Report that ``done`` of ``total`` steps of ``stage`` are finished."""


def silent(stage: str, done: int, total: int, note: str = "") -> None:
    """Report nothing."""
