"""What is dear to compute and depends on its input only: kept on disk under the hash of that input."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


def content_key(kind: str, *parts: Any) -> str:
    """Return the SHA-256 (hexadecimal) of a kind and of arrays, numbers and texts."""
    digest = hashlib.sha256(kind.encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"|{part.dtype.str}{part.shape}|".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(f"|{part!r}|".encode())
    return digest.hexdigest()


def stored(key: str, build: Callable[[], Arrays]) -> Arrays:
    """Return the arrays kept under ``key``, or build and keep them; a cache that cannot be written is no error."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "netdesign" / "motion"
    path = root / f"{key[:40]}.npz"
    found = _read(path)
    if found is not None:
        return found
    arrays = build()
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        root.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
    return arrays


def _read(path: Path) -> Arrays | None:
    """Return the arrays of a file, None when it is missing or was cut short."""
    try:
        with np.load(path) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, BadZipFile, EOFError):
        return None
