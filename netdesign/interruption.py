"""SIGTERM ends a command as Ctrl-C does: what is done is kept, one line is said."""

import os
import signal
from types import FrameType


def end_cleanly() -> None:
    """Make SIGTERM raise KeyboardInterrupt in this process; worker processes end at once."""
    main = os.getpid()

    def terminated(number: int, frame: FrameType | None) -> None:
        if os.getpid() == main:
            raise KeyboardInterrupt
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    signal.signal(signal.SIGTERM, terminated)
