"""How kernels are compiled: one set of options, as little work as possible, a cache that notices every edit.

An ``entry`` is called from Python: compiled for the types that it meets and kept on disk. A ``part`` is called by
entries: it becomes machine code inside them only, which halves what a first run has to compile. Called from Python a
part is plain Python, slow and right.

Numba's own functions that a kernel calls (``empty``, ``max``) are parts as well: by default each is optimised and made
executable by itself, once for every set of options, wrappers for Python and C included.

Numba keeps an entry until its own file changes. Here the key also holds every file whose parts and entries it calls,
and the constants it reads, so that an edit anywhere in a kernel is never answered by yesterday's machine code.
"""

import gc
import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import Any

import numpy as np
from numba import jit, njit
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.runtime import rtsys
from numba.core.target_extension import jit_registry, target_registry
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
        if getattr(kernel, "_cache", None).__class__ is FunctionCache:
            kernel._cache = _Cache(function)
        index: Any = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
        if hasattr(index, "_source_stamp"):
            index._source_stamp = "\n".join(sorted(_sources[kernel]))
        return kernel

    return decorate


def part(*, fastmath: frozenset[str] | bool = False, allocates: bool = True) -> Callable[[Function], Any]:
    """Return a decorator of functions that kernels call.

    One that ``allocates`` no array need not count references, which in the innermost loops takes longer than the work.
    """

    def decorate(function: Function) -> Any:
        _sources[function] = _dependencies(function)
        options = _OPTIONS if allocates else {**_OPTIONS, "_nrt": False}
        register = register_jitable(pipeline_class=_PartCompiler, fastmath=_flags(fastmath), **options)
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


class _Cache(FunctionCache):
    """Machine code on disk, loaded without numba's thousands of declarations: those are for compiling.

    They also make LAPACK and hash functions known: a kernel that calls those needs them.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled kernel of a signature, None when it is not there."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


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


class _Flags(Flags):
    """Options of a kernel; what it calls inherits only those that matter to it.

    Numba keeps an ``empty`` or ``max`` for every set of options that it was compiled under, wrappers and threads
    included. Whether a kernel counts references is its own affair as well: a part says so itself, and the rest is too
    small for it to matter.
    """

    __slots__ = ()

    def copy(self) -> Flags:
        """Return what is inherited, one object for each choice of them."""
        inherited = _Inherited()
        inherited.nrt = True
        for name in ("fastmath", "error_model"):
            setattr(inherited, name, getattr(self, name))
        return _inherited.setdefault(inherited.summary(), inherited)

    def __hash__(self) -> int:
        return _HASH

    def __eq__(self, other: object) -> bool:
        return bool(super().__eq__(other))


class _Inherited(_Flags):
    """One of few: numba compares sixty options for every function that a call might mean."""

    __slots__ = ()

    def __hash__(self) -> int:
        return _HASH

    def __eq__(self, other: object) -> bool:
        return self is other or (not isinstance(other, _Inherited) and bool(super().__eq__(other)))


_HASH = hash(Flags())  # numba's hash does not look at the values
_inherited: dict[str, _Inherited] = {}


class _EntryCompiler(Compiler):
    """Numba's compiler with a library of ours; numba's own functions that a kernel calls become parts of it."""

    library = _EntryLibrary

    def __init__(self, typingctx, targetctx, library, args, return_type, flags, locals):  # type: ignore[no-untyped-def]
        own = self.library(targetctx.codegen(), "kernel")
        own.enable_object_caching()
        super().__init__(typingctx, targetctx, own, args, return_type, _Flags(flags), locals)

    def _compile_core(self) -> Any:
        cpu = target_registry["cpu"]
        if jit_registry[cpu] is _part_of_numba:
            return super()._compile_core()
        jitter = jit_registry.pop(cpu)
        jit_registry[cpu] = _part_of_numba
        collecting = gc.isenabled()
        gc.disable()  # nearly all that a compiler makes stays: looking for waste takes a tenth of the time
        try:
            return super()._compile_core()
        finally:
            if collecting:
                gc.enable()
            del jit_registry[cpu]
            jit_registry[cpu] = jitter


class _PartCompiler(_EntryCompiler):
    library = _PartLibrary


def _part_of_numba(**options: Any) -> Any:
    """Return numba's decorator of an overload."""
    return jit(**{"pipeline_class": _PartCompiler, "no_cfunc_wrapper": True, **options})
