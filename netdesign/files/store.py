"""Writing without half-written files, and the envelope that every JSON file of ours carries."""

import errno
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from netdesign import __version__
from netdesign.errors import InputError


def write_bytes(path: Path, data: bytes) -> None:
    """Write beside ``path`` and rename, so that a reader sees the old file or the new one, never half of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except OSError as error:  # what the reader knows is the file that was to be written
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        beside.unlink(missing_ok=True)


def demand_writable(path: Path) -> None:
    """Return when ``write_bytes`` can write ``path``, without writing: for what takes minutes to compute.

    Raises:
        OSError: ``path`` is a folder, lies below a file, or in a folder where nothing may be written.
    """
    above = next(folder for folder in (path.parent, *path.parent.parents) if folder.exists())
    for trouble, found in (
        (errno.EISDIR, path.is_dir()),
        (errno.ENOTDIR, not above.is_dir()),
        (errno.EACCES, not os.access(above, os.W_OK)),
    ):
        if found:
            raise OSError(trouble, os.strerror(trouble), str(path))


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text like ``write_bytes``."""
    write_bytes(path, text.encode())


def write_json(path: Path, kind: str, payload: dict[str, Any], study_sha256: str | None = None) -> None:
    """Write ``payload`` as ``netdesign/<kind>/1``: sorted keys, infinite and undefined numbers as null.

    The same payload gives the same bytes: no date, host name or absolute path is added.
    """
    envelope = {"format": f"netdesign/{kind}/1", "netdesign_version": __version__}
    if study_sha256 is not None:
        envelope["study_sha256"] = study_sha256
    text = json.dumps(plain({**payload, **envelope}), sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")


def read_json(path: Path, kind: str) -> dict[str, Any]:
    """Read a JSON file of the given kind.

    Raises:
        InputError: the file is missing, is not JSON or is of another kind.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected JSON, found {error}") from None
    found = content.get("format") if isinstance(content, dict) else type(content).__name__
    if found != f"netdesign/{kind}/1":
        raise InputError(f'{path}: expected "format": "netdesign/{kind}/1", found {found!r}')
    return dict(content)


def plain(value: Any) -> Any:
    """Return ``value`` with arrays as lists and NaN or infinity as None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        # Whole arrays at once where nothing in them needs care: thousands of points would take seconds one by one.
        easy = value.dtype == np.float64 and bool(np.isfinite(value).all())
        return (value + 0.0).tolist() if easy else plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value + 0.0 if math.isfinite(value) else None  # -0.0 becomes 0.0
    return value
