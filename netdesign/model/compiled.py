"""How kernels are compiled: one set of options, as little work as possible, a cache that notices every edit.

An ``entry`` is called from Python: compiled for the types that it meets and kept on disk. A ``part`` is called by
entries: it becomes machine code inside them only, which halves what a first run has to compile. Called from Python a
part is plain Python, slow and right.

Numba keeps an entry until its own file changes. Here the key also holds every file whose parts and entries it calls,
and the constants it reads, so that an edit anywhere in a kernel is never answered by yesterday's machine code.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import Any

import numpy as np
from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.extending import register_jitable

Function = Callable[..., Any]

FAST = frozenset({"contract", "reassoc", "arcp", "nsz"})
"""Fast arithmetic that still knows infinite and undefined numbers."""

_OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True}
_sources: dict[Any, frozenset[str]] = {}  # what a kernel's machine code depends on: files and constants


def entry(*, fastmath: frozenset[str] | bool = False, nogil: bool = False) -> Callable[[Function], Any]:
    """Return a decorator of kernels that Python calls; ``nogil``: other threads may run meanwhile."""

    def decorate(function: Function) -> Any:
        kernel = njit(cache=True, pipeline_class=_EntryCompiler, fastmath=_flags(fastmath), nogil=nogil, **_OPTIONS)(
            function
        )
        _sources[kernel] = _dependencies(function)
        index: Any = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
        if hasattr(index, "_source_stamp"):
            index._source_stamp = "\n".join(sorted(_sources[kernel]))
        return kernel

    return decorate


def part(*, fastmath: frozenset[str] | bool = False) -> Callable[[Function], Any]:
    """Return a decorator of functions that kernels call."""

    def decorate(function: Function) -> Any:
        _sources[function] = _dependencies(function)
        register = register_jitable(pipeline_class=_PartCompiler, fastmath=_flags(fastmath), **_OPTIONS)
        return register(function)

    return decorate


def _flags(fastmath: frozenset[str] | bool) -> set[str] | bool:
    return fastmath if isinstance(fastmath, bool) else set(fastmath)


def _dependencies(function: Function) -> frozenset[str]:
    """The files of a kernel and of all it calls, the constants it reads."""
    found = {_contents(function.__code__.co_filename)}
    for name in _names(function.__code__):
        value = function.__globals__.get(name)
        if isinstance(value, int | float | str | tuple | frozenset | np.ndarray):
            found.add(f"{name} = {value.tolist() if isinstance(value, np.ndarray) else value!r}")
        elif callable(value):
            found |= _sources.get(value, frozenset())
    return frozenset(found)


def _names(code: CodeType) -> set[str]:
    """Every global name of a function and of the functions within it."""
    inner = [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return set(code.co_names).union(*map(_names, inner))


@cache
def _contents(path: str) -> str:
    """A source file by what is in it, not by its date."""
    try:
        return f"{Path(path).name} {hashlib.sha256(Path(path).read_bytes()).hexdigest()}"
    except OSError:  # typed into an interpreter: numba does not keep it either
        return path


class _EntryLibrary(JITCodeLibrary):
    """Code of an entry: optimised once, when everything that it calls has been linked in."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


class _PartLibrary(_EntryLibrary):
    """Code of a part: linked into the entries that call it, never optimised or made executable by itself."""

    codegen = SimpleNamespace(set_env=lambda name, environment: None)  # there is no executable to tell

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, numba's "no such symbol"."""
        self._ensure_finalized()
        return 0

    def _optimize_final_module(self) -> None:
        return None

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _EntryCompiler(Compiler):
    """Numba's compiler with a library of ours."""

    library = _EntryLibrary

    def __init__(self, typingctx, targetctx, library, args, return_type, flags, locals):  # type: ignore[no-untyped-def]
        own = self.library(targetctx.codegen(), "kernel")
        own.enable_object_caching()
        super().__init__(typingctx, targetctx, own, args, return_type, flags, locals)


class _PartCompiler(_EntryCompiler):
    library = _PartLibrary
