"""Connects to a running Dask scheduler, which takes the scans of a batch or the blocks of a large scan."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gnrecon.runtime.errors import UsageError


def require_distributed() -> Any:
    """Return the package `distributed`.

    Raises
    ------
    UsageError
        When it is not installed.
    """
    try:
        import distributed
    except ImportError:
        raise UsageError("Dask is not installed; add it by: pip install 'gnrecon[cluster]'.") from None
    return distributed


@contextmanager
def dask_client(address: str, *, timeout: str = "20s") -> Iterator[Any]:
    """Yield a `distributed.Client` of the scheduler at an address such as ``tcp://host:8786``.

    Parameters
    ----------
    address : of the scheduler
    timeout : how long to wait for its answer, as Dask writes durations

    Raises
    ------
    UsageError
        When Dask is not installed, or the scheduler does not answer.
    """
    distributed = require_distributed()
    try:
        client = distributed.Client(address, timeout=timeout, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"No scheduler answers at {address} ({error}).") from error
    with client:
        yield client
