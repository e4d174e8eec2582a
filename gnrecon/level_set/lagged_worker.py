"""A worker thread whose result is used one call later, so that it runs in parallel to the caller and is reproducible.

If results were used as soon as they are ready, a run would depend on the load of the machine. Here the lag is fixed:
each call submits a new input and returns the result for the previous one, and waits for it if necessary. The same run
gives the same result. As long as the work takes no longer than the caller does between two calls, it costs no time. The
work must release Python's global interpreter lock, as torch and gudhi do.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, TypeVar

import torch

from gnrecon.runtime.parallel import set_threads

Input = TypeVar("Input")

Result = TypeVar("Result")


class LaggedWorker(Generic[Input, Result]):
    """One worker thread for one function; use it in a `with` statement, which ends the thread.

    Parameters
    ----------
    work : a function of its input only, which must not be changed after the call
    """

    def __init__(self, work: Callable[[Input], Result]) -> None:
        self._work = work
        # With as many torch threads as the caller.
        self._pool = ThreadPoolExecutor(1, initializer=set_threads, initargs=(torch.get_num_threads(),))
        self._last: Future[Result] | None = None

    def __call__(self, current: Input) -> Result:
        """Submit an input and return the result for the previous one, or at the first call for this one."""
        following = self._pool.submit(self._work, current)
        previous, self._last = self._last, following
        return (previous or following).result()

    def __enter__(self) -> LaggedWorker[Input, Result]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
