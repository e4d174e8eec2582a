"""Runs independent tasks in threads, each with one torch thread, and limits torch's threads for a block of code.

The matrices of a fit are small. Several threads on one product spend longer waiting for each other than working, so
each task gets a single torch thread and several tasks run at once. This helps only for tasks that release Python's
global lock, as torch, numpy and scipy do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

import torch

from gnrecon.runtime.progress import ProgressCallback, ignore_progress

Item = TypeVar("Item")

Result = TypeVar("Result")

_lock = Lock()


def set_threads(count: int) -> None:
    """Set the number of torch threads for calls from this thread, and from no other.

    `torch.set_num_threads` also sets the number for threads that start later. A fresh thread reads that number and
    restores it.
    """
    with _lock, ThreadPoolExecutor(1) as fresh_thread:
        default = fresh_thread.submit(torch.get_num_threads).result()
        torch.set_num_threads(count)
        fresh_thread.submit(torch.set_num_threads, default).result()


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Run a block with this number of torch threads, and restore the previous number; None changes nothing.

    With one thread, sums do not depend on the number of processors; with several, they differ in the last digits.
    """
    before = torch.get_num_threads()
    try:
        if count is not None:
            set_threads(count)
        yield
    finally:
        if count is not None:
            set_threads(before)


def map_in_threads(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    device: str | torch.device = "cpu",
    advance: ProgressCallback = ignore_progress,
) -> list[Result]:
    """Return ``work(item)`` for all items, in their order, computed in as many threads as torch has.

    Each call has one torch thread, so the results do not depend on the number of threads.

    Parameters
    ----------
    work : function of an item; it must not depend on the order of the calls
    items : sequence
    device : where the work is done; on a GPU the calls run one after the other
    advance : called with the share of items that are done
    """

    def report(result: Result, number: int) -> Result:
        advance(number / len(items))
        return result

    threads = min(torch.get_num_threads(), len(items))
    if threads <= 1 or torch.device(device).type != "cpu":
        return [report(work(item), number) for number, item in enumerate(items, 1)]
    pool = ThreadPoolExecutor(threads, initializer=set_threads, initargs=(1,))
    try:
        futures = [pool.submit(work, item) for item in items]
        return [report(future.result(), number) for number, future in enumerate(futures, 1)]
    finally:
        pool.shutdown(cancel_futures=True)
