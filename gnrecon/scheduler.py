"""A Dask scheduler that is there already, for whoever hands tasks in: batches of scans and blocks of a large one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gnrecon.errors import UsageError

PATIENCE = "20s"


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
def connected(address: str) -> Iterator[Any]:
    """Give a `distributed.Client` of the scheduler at an address such as ``tcp://host:8786``.

    Raises
    ------
    UsageError
        When Dask is not installed, or the scheduler does not answer.
    """
    distributed = require_distributed()
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"No scheduler answers at {address} ({error}).") from error
    with client:
        yield client
