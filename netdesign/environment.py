"""What must be in the environment before the numerical libraries are imported."""

import os
import tempfile
from pathlib import Path

KERNELS = Path(__file__).parent / "model"


def prepare_environment() -> None:
    """Set what the libraries read when they are imported; what the user has set stays."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait for each other
    # numba keeps compiled kernels beside the source, else in the user's cache, and where it may write in neither (an
    # installation for all users, a container without a home) it compiles nothing at all.
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"
    if not any(_may_write(folder) for folder in (KERNELS / "__pycache__", user_cache)):
        os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"netdesign-kernels-{os.getuid()}"))


def _may_write(folder: Path) -> bool:
    """Whether files can be written into ``folder``, which may still have to be made."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    return there.is_dir() and os.access(there, os.W_OK)
