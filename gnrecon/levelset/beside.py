"""Work that runs beside the caller's, on what the caller had one call ago.

An answer that is computed in another thread would usually be taken whenever it is there, and a run would depend on how
busy the machine is. Here the lag is fixed: each call hands over a new input and returns the answer to the one before,
for which it waits if need be. So the same run gives the same result, and as long as the work takes no longer than what
the caller does between two calls, it costs nothing but a processor that was idle. What does the work must release
Python's lock while it does, as torch and gudhi do.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, TypeVar

import torch

from gnrecon.runtime.parallel import set_threads

Input = TypeVar("Input")
Answer = TypeVar("Answer")


class Beside(Generic[Input, Answer]):
    """One worker for one function; use it in a `with` statement, which ends the worker.

    Parameters
    ----------
    work : a function of nothing but its input, which must not change any more once it is handed over
    """

    def __init__(self, work: Callable[[Input], Answer]) -> None:
        self._work = work
        # As many of torch's threads as the one that asks has.
        self._pool = ThreadPoolExecutor(1, initializer=set_threads, initargs=(torch.get_num_threads(),))
        self._last: Future[Answer] | None = None

    def __call__(self, current: Input) -> Answer:
        """Hand over an input and return the answer to the previous one; at the first call, that to this one."""
        following = self._pool.submit(self._work, current)
        previous, self._last = self._last, following
        return (previous or following).result()

    def __enter__(self) -> Beside[Input, Answer]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
