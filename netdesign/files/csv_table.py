"""Tables as CSV with a header line; every complaint names the file and the line."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from netdesign.errors import InputError


def csv_rows(path: Path, required: Sequence[str], instead: Sequence[str] = ()) -> list[tuple[str, dict[str, str]]]:
    """Return ("file:line", row) of a CSV file with at least the given columns; lines that begin with # are comments.

    Args:
        instead: columns that may stand in place of the last one required.

    Raises:
        InputError: no such file, not text, or a column is missing.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a file, found a folder") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected UTF-8 text, found {error.reason} at byte {error.start}") from None
    return table_rows(text, path, required, instead)


def table_rows(
    text: str, path: Path, required: Sequence[str], instead: Sequence[str] = ()
) -> list[tuple[str, dict[str, str]]]:
    """Return the same of the text of a table; ``path`` is for messages.

    Raises:
        InputError: a column is missing, or a row has too few or too many values.
    """
    # Comments become empty lines, which csv passes over: the line numbers stay right.
    lines = ["" if line.lstrip().startswith("#") else line for line in _lines(text)]
    header = next((number for number, line in enumerate(lines) if line.strip()), 0)
    delimiter = next((mark for mark in ",;\t" if mark in lines[header]), ",")
    reader = csv.DictReader(io.StringIO("\n".join(lines[header:])), skipinitialspace=True, delimiter=delimiter)
    names = [name.strip() for name in reader.fieldnames or ()]
    reader.fieldnames = names
    missing = [name for name in required if name not in names]
    replaced = missing == [required[-1]] and bool(instead) and all(name in names for name in instead)
    if missing and not replaced:
        raise InputError(f"{path}:{header + 1}: expected columns {','.join(required)}, found no {missing[0]}")
    rows = []
    for row in reader:
        where = f"{path}:{header + reader.line_num}"
        if None in row or any(value is None for value in row.values()):
            raise InputError(f"{where}: expected {len(names)} values, found another number of them")
        rows.append((where, {name: value.strip() for name, value in row.items()}))
    return rows


def _lines(text: str) -> list[str]:
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def numbers(where: str, row: dict[str, str], names: Sequence[str]) -> list[float]:
    """Return finite numbers of a row."""
    values = []
    for name in names:
        try:
            value = float(row[name])
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise InputError(f"{where}: {name}: expected a finite number, found {row[name]!r}")
        values.append(value)
    return values


def index_of(where: str, what: str, key: str, table: dict[str, int]) -> int:
    """Return the index of a name; a number may be written with zeros in front or behind its point."""
    if key not in table:
        try:
            key_as_number = str(int(float(key))) if float(key).is_integer() else key
        except (ValueError, OverflowError):
            key_as_number = key
        if key_as_number not in table:
            raise InputError(f"{where}: {what} {key!r} is not in the COLMAP model")
        return table[key_as_number]
    return table[key]
