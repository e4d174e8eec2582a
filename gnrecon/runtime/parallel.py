"""Runs independent pieces of work in threads, each with one torch thread, so that results do not depend on the threads.

A sum that several threads share depends in its last digits on how many there are. So each product and sum is that of
one thread (`fixed_sums`), and several threads work on different pieces, whose results are put together in the order of
the pieces. It costs little: the matrices of a fit are small, and several threads on one product spend longer waiting
for each other than working. Threads help only with pieces that release Python's global lock, as torch, numpy and scipy
do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from functools import cached_property
from queue import Empty, SimpleQueue
from threading import Event, Lock
from typing import TYPE_CHECKING, TypeVar

import torch

from gnrecon.runtime.progress import ProgressCallback, ignore_progress

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")

Result = TypeVar("Result")

_lock = Lock()


class _Workers:
    """Threads for pieces of work, each with one torch thread, started when they are first used."""

    def __init__(self, count: int) -> None:
        self.count = count

    @cached_property
    def pool(self) -> ThreadPoolExecutor:
        """The threads, which stay, because to start them takes as long as a small product."""
        return ThreadPoolExecutor(self.count, initializer=set_threads, initargs=(1,))

    def close(self) -> None:
        """End the threads if any were started."""
        if "pool" in vars(self):
            self.pool.shutdown()


_workers: ContextVar[_Workers | None] = ContextVar("_workers", default=None)
"""Those of a block that fixes sums; a thread that starts later does not inherit them."""


def worker_count() -> int:
    """Return how many threads `map_in_threads` uses: those of `fixed_sums`, elsewhere as many as torch has."""
    workers = _workers.get()
    return torch.get_num_threads() if workers is None else workers.count


@contextmanager
def fixed_sums(threads: int | None) -> Iterator[None]:
    """Run a block whose results are the same for any number of threads.

    Each product and sum of torch, and of the OpenBLAS of numpy and scipy, is that of one thread; `map_in_threads`
    still uses several, for different pieces.

    Parameters
    ----------
    threads : for pieces of work; by default as many as the caller has
    """
    workers = _Workers(threads or worker_count())
    before = _workers.set(workers)
    try:
        with torch_threads(1), _one_blas_thread:
            yield
    finally:
        _workers.reset(before)
        workers.close()


class _OneBlasThread:
    """Limits OpenBLAS to one thread while any block runs; its number is that of the process, not of one thread."""

    def __init__(self) -> None:
        self._lock, self._blocks, self._limit = Lock(), 0, ExitStack()

    @cached_property
    def _libraries(self) -> ThreadpoolController:
        """The OpenBLAS of numpy and scipy; to look for them takes as long as a small product."""
        import scipy.linalg  # noqa: F401 - scipy brings an OpenBLAS of its own, which must be loaded to be limited
        from threadpoolctl import ThreadpoolController

        # The MKL of torch is not among them: `torch_threads` limits it, in the calling thread alone.
        return ThreadpoolController().select(internal_api="openblas")

    def __enter__(self) -> None:
        with self._lock:
            if self._blocks == 0:
                self._limit.enter_context(self._libraries.limit(limits=1))
            self._blocks += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0:
                self._limit.close()


_one_blas_thread = _OneBlasThread()


def set_threads(count: int) -> None:
    """Set the number of torch threads for calls from this thread, and from no other.

    `torch.set_num_threads` also sets the number for threads that start later. A fresh thread reads that number and
    restores it.
    """
    torch.get_num_threads()  # the first call of a thread replaces what was set before it by the default
    with _lock, ThreadPoolExecutor(1) as fresh_thread:
        default = fresh_thread.submit(torch.get_num_threads).result()
        torch.set_num_threads(count)
        fresh_thread.submit(torch.set_num_threads, default).result()


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Run a block with this number of torch threads, and restore the previous number; None changes nothing.

    Sums depend on the number in their last digits.
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
    *,
    brief: bool = False,
) -> list[Result]:
    """Return ``work(item)`` for all items, in their order, computed in `worker_count` threads.

    Each call has one thread of torch and of OpenBLAS, so the results do not depend on the number of threads, and no
    two calls wait for each other's threads.

    Parameters
    ----------
    work : function of an item; it must not depend on the order of the calls
    items : sequence
    device : where the work is done; on a GPU the calls run one after the other
    advance : called with the share of items that are done
    brief : whether the calls take no longer than to start threads, so that only those of `fixed_sums`, which stay, are
        worth it
    """

    def report(result: Result, number: int) -> Result:
        advance(number / len(items))
        return result

    kept = _workers.get()
    alone = min(worker_count(), len(items)) <= 1 or (brief and kept is None)
    if alone or torch.device(device).type != "cpu":
        return [report(work(item), number) for number, item in enumerate(items, 1)]
    workers = kept or _Workers(worker_count())
    with _one_blas_thread:
        futures = [workers.pool.submit(work, item) for item in items]
        try:
            return [report(future.result(), number) for number, future in enumerate(futures, 1)]
        finally:
            # None runs on when one has failed.
            wait([future for future in futures if not future.cancel()])
            if workers is not kept:
                workers.close()


@contextmanager
def in_background(work: Callable[[], Result]) -> Iterator[Callable[[], Result]]:
    """Do some work in a thread of its own while the block runs, and give it a function that returns the result.

    Where there is one worker, the work is done when its result is wanted. It has one thread of torch either way, and is
    waited for at the end of the block.
    """
    if worker_count() < 2:
        yield work
        return
    with ThreadPoolExecutor(1, initializer=set_threads, initargs=(1,)) as pool:
        yield pool.submit(work).result


class _Runs:
    """What runs that share the time of a caller have in common: its request that they end, and calls that it makes."""

    def __init__(self) -> None:
        self.calls: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self.asked, self.ended = Event(), False


_runs: ContextVar[_Runs | None] = ContextVar("_runs", default=None)
"""Those that a thread is one of."""


def run_in_threads(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    device: str | torch.device = "cpu",
    is_last: Callable[[Result], bool] = lambda _: False,
    *,
    check_seconds: float = 0.02,
) -> list[Result]:
    """Return ``work(item)`` for long runs that are independent, in their order, up to the first that is the last.

    As many as there are workers run side by side, each in one thread, and the next one starts when one ends; a run that
    is alone has all threads for the pieces of its own work. The results are the same for any number of threads.

    Parameters
    ----------
    work : function of an item. It calls `end_if_asked` from time to time, and `call_outside` for what must run in the
        caller's thread
    items : sequence
    device : where the work is done; on a GPU the runs follow one another
    is_last : whether the results after one are not wanted; runs that have started already are asked to end
    check_seconds : between two looks at the runs

    Raises
    ------
    KeyboardInterrupt
        When the caller is interrupted, and no run has returned what it had.
    """
    together = min(worker_count(), len(items)) if torch.device(device).type == "cpu" else 1
    if together > 1:
        return _run_together(work, items, is_last, together, check_seconds)
    found: list[Result] = []
    for item in items:
        found.append(work(item))
        if is_last(found[-1]):
            break
    return found


def _run_together(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    is_last: Callable[[Result], bool],
    together: int,
    check_seconds: float,
) -> list[Result]:
    """Return the results of runs of which several are running at the same time."""
    runs = _Runs()

    def run(item: Item) -> Result:
        _workers.set(_Workers(1))
        _runs.set(runs)
        return work(item)

    def wait_for(future: Future[Result]) -> Result:
        """Return its result; until then, make the calls of all runs."""
        while not (future.done() and runs.calls.empty()):
            wait([future], check_seconds)
            with suppress(Empty):
                while True:
                    runs.calls.get_nowait()()
        return future.result()

    found: list[Result] = []
    with ThreadPoolExecutor(together, initializer=set_threads, initargs=(1,)) as pool:
        futures = [pool.submit(run, item) for item in items]
        try:
            for future in futures:
                found.append(wait_for(future))
                if is_last(found[-1]):
                    break
        except BaseException as error:
            started = _ended(futures, runs)
            if not (isinstance(error, KeyboardInterrupt) and runs.ended):
                raise
            return [future.result() for future in started]
        _ended(futures, runs)
    return found


def _ended(futures: Sequence[Future[Result]], runs: _Runs) -> list[Future[Result]]:
    """Ask runs to end, wait for those that have started, and return these."""
    runs.asked.set()
    started = [future for future in futures if not future.cancel()]
    wait(started)
    return started


def end_if_asked() -> None:
    """Raise `KeyboardInterrupt` in a run of `run_in_threads` whose caller has been interrupted."""
    runs = _runs.get()
    if runs is not None and runs.asked.is_set():
        runs.ended = True
        raise KeyboardInterrupt


def call_outside(call: Callable[[], object]) -> None:
    """Let the thread that waits for this run of `run_in_threads` make a call; elsewhere make it at once."""
    runs = _runs.get()
    if runs is None:
        call()
    else:
        runs.calls.put(call)
