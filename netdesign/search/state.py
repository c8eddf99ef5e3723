"""The whole state of a search between two steps, and its file: a killed search resumes to the same result."""

import json
import os
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from netdesign.errors import InputError
from netdesign.search.archive import Archive
from netdesign.search.population import Floats, Ints, Population, joined

VERSION = 4


@dataclass(frozen=True, kw_only=True)
class State:
    """Everything the rest of a search depends on.

    Attributes:
        step: generations done, those of the local search included.
        population: the current generation.  ranks, crowding: (P,) of it, as its survivors were chosen.
        archive: the best of every size, of all but the pending ones.
        pending: chromosomes evaluated since the archive was updated.
        evaluations, hypervolume: (h,) history, one entry per update of the archive.
        random: state of the random numbers, JSON.
    """

    step: int
    population: Population
    ranks: Ints
    crowding: Floats
    archive: Archive
    evaluations: Ints
    hypervolume: Floats
    random: str
    pending: tuple[Population, ...] = ()

    @property
    def spent(self) -> int:
        """Evaluations so far."""
        return (int(self.evaluations[-1]) if len(self.evaluations) else 0) + sum(map(len, self.pending))


def generator_state(rng: np.random.Generator) -> str:
    """Return the generator's state as JSON."""
    return json.dumps(rng.bit_generator.state)


def restored_generator(state: str) -> np.random.Generator:
    """Return a generator that goes on where ``state`` was taken."""
    rng = np.random.Generator(np.random.PCG64())
    rng.bit_generator.state = json.loads(state)
    return rng


def save(path: Path, state: State, key: str) -> None:
    """Write the state beside its place, then rename: the file is always whole.

    Args:
        path: .npz.
        key: identifies the search (study, seed, settings); :func:`load` asks for the same.
    """
    arrays: dict[str, np.ndarray] = {
        "version": np.array(VERSION),
        "key": np.array(key),
        "step": np.array(state.step),
        "ranks": state.ranks,
        "crowding": state.crowding,
        "evaluations": state.evaluations,
        "hypervolume": state.hypervolume,
        "random": np.array(state.random),
    }
    pending = joined([state.population.take(np.arange(0)), *state.pending])
    stored = {"population": state.population, "archive": state.archive.members, "pending": pending}
    for prefix, population in stored.items():
        for field in fields(population):
            arrays[f"{prefix}_{field.name}"] = getattr(population, field.name)
    try:
        with _beside(path).open("wb") as scratch:
            np.savez(scratch, **arrays)  # type: ignore[arg-type]
        os.replace(_beside(path), path)
    except BaseException:
        _beside(path).unlink(missing_ok=True)
        raise


def discard(path: Path) -> None:
    """Remove a checkpoint that is no longer needed, and what a search killed while it wrote may have left beside it."""
    path.unlink(missing_ok=True)
    _beside(path).unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")


def load(path: Path, key: str) -> State:
    """Return the state of a search.

    Raises:
        InputError: the file cannot be read, or belongs to another search.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            if int(stored["version"]) != VERSION or str(stored["key"]) != key:
                raise InputError(f"{path}: this checkpoint belongs to another study, seed or version; delete it")
            populations = [
                Population(**{field.name: stored[f"{prefix}_{field.name}"] for field in fields(Population)})
                for prefix in ("population", "archive", "pending")
            ]
            return State(
                step=int(stored["step"]),
                population=populations[0],
                ranks=stored["ranks"],
                crowding=stored["crowding"],
                archive=Archive(members=populations[1]),
                evaluations=stored["evaluations"],
                hypervolume=stored["hypervolume"],
                random=str(stored["random"]),
                pending=(populations[2],) if len(populations[2]) else (),
            )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as problem:
        raise InputError(f"{path}: not a readable checkpoint ({problem}); delete it") from problem
