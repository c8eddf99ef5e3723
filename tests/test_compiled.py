"""Compiled kernels: the cache notices every edit of a part, of its file or of a constant; numba stays as it was."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numba.core.target_extension import jit_registry

from netdesign.model.compiled import entry, part
from netdesign.placement.evaluation import excess, popcount

ROOT = Path(__file__).parents[1]

INNER = """
from netdesign.model.compiled import part

OFFSET = {offset}

@part()
def shifted(x):
    return {factor} * x
"""

OUTER = """
from inner import OFFSET, shifted
from netdesign.model.compiled import entry

@entry()
def outer(x):
    return shifted(x) + OFFSET

print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""


def test_an_edit_of_a_part_is_noticed(tmp_path):
    (tmp_path / "outer.py").write_text(OUTER, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    said = []
    for offset, factor in ((0.5, 2.0), (0.5, 2.0), (0.5, 3.0), (0.25, 3.0)):
        (tmp_path / "inner.py").write_text(INNER.format(offset=offset, factor=factor), encoding="utf-8")
        answer = subprocess.run(
            [sys.executable, "-B", "outer.py"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        said.append(answer.stdout.split())
    assert said == [["2.5", "0"], ["2.5", "1"], ["3.5", "0"], ["3.25", "0"]]


def test_a_kernel_kept_on_disk_serves_a_caller_compiled_anew_and_python(tmp_path):
    kept = "from netdesign.model.compiled import entry\n\n@entry()\ndef twice(x):\n    return 2.0 * x\n"
    caller = """
from kept import twice
from netdesign.model.compiled import entry

@entry()
def caller(x):
    return twice(x) + {offset}

print(caller(1.0), twice(3.0), sum(twice.stats.cache_hits.values()))
"""
    (tmp_path / "kept.py").write_text(kept, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    said = []
    for offset in (0.5, 0.25):
        (tmp_path / "caller.py").write_text(caller.format(offset=offset), encoding="utf-8")
        command = [sys.executable, "-B", "caller.py"]
        answer = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        said.append(answer.stdout.split())
    assert said == [["2.5", "6.0", "0"], ["2.25", "6.0", "1"]]


def test_a_kernel_is_loaded_without_the_declarations_that_compiling_needs(tmp_path):
    """It allocates, returns arrays and tuples, and raises; the same from the compiler and from the disk."""
    kernel = """
import sys
import numpy as np
from netdesign.model.compiled import entry

@entry()
def kernel(x):
    if x.shape[0] == 0:
        raise ValueError("empty")
    found = np.zeros((2, x.shape[0]))
    found[0] = np.sqrt(x)
    return found, x.sum()

found, total = kernel(np.array([4.0, 9.0]))
try:
    kernel(np.zeros(0))
except ValueError as error:
    print(found[0].tolist(), total, error, "numba.typed.typeddict" in sys.modules)
"""
    (tmp_path / "kernel.py").write_text(kernel, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-B", "kernel.py"]
    said = [
        subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert said == [f"[2.0, 3.0] 13.0 empty {compiled}\n" for compiled in (True, False)]


def test_a_part_is_the_same_function_from_python_and_compiled():
    @part()
    def squared(x):
        return x * x

    @entry()
    def total(values):
        result = 0.0
        for value in values:
            result += squared(value)
        return result

    values = np.random.default_rng(0).random(20)
    assert squared(1.5) == 2.25
    np.testing.assert_allclose(total(values), (values**2).sum(), rtol=1e-14)
    bits = entry()(popcount)
    for word in (0, 1, 2**63, 2**64 - 1, 0x0123456789ABCDEF):
        assert bits(np.uint64(word)) == word.bit_count()
    assert entry()(excess)(2.0, 1.0) == excess(2.0, 1.0) == 0.5


def test_functions_of_numba_that_a_kernel_calls_serve_others_too():
    @entry()
    def ours(count):
        values = np.zeros((count, 2), np.float32)
        for index in range(count):
            values[index, 1] = max(index, 3)
        return values.sum()

    @njit
    def theirs(count):
        values = np.zeros((count, 2), np.float32)
        for index in range(count):
            values[index, 1] = max(index, 3)
        return values.sum()

    @entry()
    def wrong(count):
        return np.zeros(count).no_such_thing()

    before = dict(jit_registry)
    assert ours(6) == theirs(6) == 3 * 4 + 4 + 5
    with pytest.raises(TypingError):
        wrong(3)
    assert dict(jit_registry) == before
    assert njit(lambda count: np.ones(count).sum())(5) == 5.0


NEEDS_DECLARATIONS = {"linalg", "dot", "vdot", "hash", "dict", "set"}


def test_no_kernel_calls_what_is_not_there_when_it_is_loaded_from_the_disk():
    """LAPACK, BLAS and hashes are known from numba's declarations only: machine code would jump to address 0."""
    kernels = 0
    for path in (ROOT / "netdesign").rglob("*.py"):
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef) or not any(
                getattr(getattr(decorator, "func", None), "id", None) in ("entry", "part")
                for decorator in function.decorator_list
            ):
                continue
            kernels += 1
            for node in ast.walk(function):
                assert not isinstance(node, ast.MatMult), f"{path.name}: {function.name} multiplies matrices by BLAS"
                name = getattr(node, "attr", getattr(node, "id", None))
                assert name not in NEEDS_DECLARATIONS, f"{path.name}: {function.name} uses {name}"
    assert kernels > 50
