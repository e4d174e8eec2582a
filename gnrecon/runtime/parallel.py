"""Threads: how many of torch's a stretch of work has, and pieces of work side by side, each with one.

The matrices of a fit are small. Threads that share every product of theirs wait for each other longer than they work,
so that a piece of work keeps to one, and several pieces are done at a time. What does the work must release Python's
lock while it does, as torch, numpy and scipy do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import Any, TypeVar

import torch

from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

Item = TypeVar("Item")

Answer = TypeVar("Answer")

_SETTING = Lock()


def set_threads(count: int) -> None:
    """Set how many threads torch has for this thread's calls alone; torch sets it for threads that begin later, too."""
    with _SETTING, ThreadPoolExecutor(1) as apart:
        default = apart.submit(torch.get_num_threads).result()
        torch.set_num_threads(count)
        apart.submit(torch.set_num_threads, default).result()


@contextmanager
def having_threads(count: int | None) -> Iterator[None]:
    """Run a block with so many of torch's threads, and set them back; None: as many as before.

    With one, sums do not depend on how many there are; by several they differ in their last digits.
    """
    before = torch.get_num_threads()
    try:
        if count is not None:
            set_threads(count)
        yield
    finally:
        if count is not None:
            set_threads(before)


def abreast(
    work: Callable[[Item], Answer],
    items: Sequence[Item],
    device: str | torch.device = "cpu",
    advance: ProgressCallback = ignore_progress,
) -> list[Answer]:
    """Return the answers to items, in their order, found as many at a time as torch has threads, each by one of them.

    So an answer does not depend on how many there are.

    Parameters
    ----------
    work : a function of its item, which must not depend on the order of the calls
    items : sequence
    device : that the work is done on; a GPU does one thing at a time, and for it so does this function
    advance : told of the share that is done
    """
    threads = min(torch.get_num_threads(), len(items))
    if threads <= 1 or torch.device(device).type != "cpu":
        return [_told(work(item), number, len(items), advance) for number, item in enumerate(items, 1)]
    pool = ThreadPoolExecutor(threads, initializer=set_threads, initargs=(1,))
    try:
        answers = [pool.submit(work, item) for item in items]
        return [_told(answer.result(), number, len(items), advance) for number, answer in enumerate(answers, 1)]
    finally:
        pool.shutdown(cancel_futures=True)


def _told(answer: Answer, number: int, count: int, advance: ProgressCallback) -> Answer:
    advance(number / count)
    return answer


PATIENCE = "20s"


# A Dask scheduler that is there already, for whoever hands tasks in: batches of scans and blocks of a large one.
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
