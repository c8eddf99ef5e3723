"""Where heavy work runs: processes of this machine, or a dask cluster."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Executor

from netdesign.errors import EnvironmentProblem, InputError
from netdesign.imageset import worker_pool


@contextlib.contextmanager
def executor_of(workers: int, dask: str | None) -> Iterator[Executor | None]:
    """Give local processes, or those of a dask cluster that shares the file system."""
    if dask is None:
        with worker_pool(workers) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise EnvironmentProblem(
            "--dask: the Python package distributed is not installed; pip install netdesign[dask]"
        ) from None
    try:
        client = Client(dask, timeout="10s")
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"--dask: expected the address of a scheduler, found {dask!r}: {error}") from None
    with client:
        yield client.get_executor()
