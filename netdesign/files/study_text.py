"""The study file as text: TOML in, a checked Study out, and every mistake as one line."""

import difflib
import tomllib
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel, ValidationError

from netdesign.errors import InputError
from netdesign.model.study import Study

# What pydantic appends to the place of a value that may be one of several kinds.
KINDS = ("float", "int", "str", "literal['free']")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        InputError: no such file, not UTF-8, or not TOML (with line and column).
    """
    try:
        # Editors on Windows put a byte order mark before the text.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a file, found a folder") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected TOML, found: {error}") from None


def parse_study(content: dict[str, Any], path: Path) -> Study:
    """Check the tables of a study file; ``path`` is for the message.

    Raises:
        InputError: one line with file, table, key, what was expected and what was found.
    """
    try:
        return Study.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error, Study)}") from None


def study_toml(study: Study) -> str:
    """Return the study as TOML with every default spelled out."""
    return tomli_w.dumps(study.model_dump(mode="json", by_alias=True, exclude_none=True))


def first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the first problem in words; an unknown key before the missing one that it was meant for."""
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    problem = problems[0]
    # A value of several kinds fails as each of them: one problem, named by its key and not by a kind.
    if problem["loc"][:-1] and problem["loc"][-1] in KINDS:
        same = [other for other in problems if other["loc"][:-1] == problem["loc"][:-1]]
        kinds = " or ".join(other["msg"].removeprefix("Input should be ").partition(",")[0] for other in same)
        others = [other for other in problems if other not in same]
        where = ".".join(str(part) for part in problem["loc"][:-1])
        more = f" (and {len(others)} more)" if others else ""
        return f"{where}: expected {kinds}, found {problem['input']!r}{more}"
    place = ".".join(str(part) for part in problem["loc"] if part not in ("single", "pair"))
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    if problem["type"] == "extra_forbidden":
        *tables, key = (str(part) for part in problem["loc"])
        known = _known_keys(model, tables)
        near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        hint = f"the nearest known key is {near[0]!r}" if near else f"known keys: {', '.join(known)}"
        return f"{place}: unknown key, {hint}{more}"
    if problem["type"] == "missing":
        return f"{place}: expected a value, found none{more}"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    context = problem.get("ctx", {})
    if problem["type"] in ("tuple_type", "list_type"):
        message = "a list in brackets"
    elif problem["type"] in ("model_type", "dict_type"):
        message = f"a table ([{place}] or key = value in braces)"
    elif problem["type"] in ("too_long", "too_short"):
        wanted = context.get("max_length", context.get("min_length"))
        return f"{place}: expected a list of {wanted}, found one of {context.get('actual_length')}{more}"
    elif problem["type"] == "string_too_short":
        message = "text"
    if problem["type"] == "value_error":
        return f"{place}: {message}{more}" if place else f"{message}{more}"
    return f"{place}: expected {message}, found {problem['input']!r}{more}"


def _known_keys(model: type[BaseModel], tables: list[str]) -> list[str]:
    """Return the keys of the table reached from ``model`` through ``tables``."""
    current = model
    for name in tables:
        for field_name, field in current.model_fields.items():
            if name in (field_name, field.alias):
                inner = [kind for kind in _classes(field.annotation) if issubclass(kind, BaseModel)]
                current = inner[0] if inner else current
    return [field.alias or name for name, field in current.model_fields.items()]


def _classes(annotation: Any) -> list[type]:
    """Return every class named in a type annotation."""
    if isinstance(annotation, type):
        nested = getattr(annotation, "__args__", ())
        return [annotation, *(found for part in nested for found in _classes(part))]
    return [found for part in getattr(annotation, "__args__", ()) for found in _classes(part)]
