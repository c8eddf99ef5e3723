"""Matrix products on one thread.

Matrices of some hundred rows are too small for threads: they wait for each other, fifty times as long on a busy
machine, and their number would change the last digits of the results.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import scipy.linalg  # noqa: F401 - brings its own BLAS, which the controller has to find
from threadpoolctl import ThreadpoolController


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let the linear algebra of numpy and scipy run on one thread; entered and left in a few µs."""
    before = [(pool, threads) for pool in _pools() if (threads := pool.get_num_threads()) != 1]
    try:
        for pool, _ in before:
            pool.set_num_threads(1)
        yield
    finally:
        for pool, threads in before:
            pool.set_num_threads(threads)


@cache
def _pools() -> list[Any]:
    return list(ThreadpoolController().select(user_api="blas").lib_controllers)
