"""The default engine: processes of this machine, several at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from queue import SimpleQueue

from gnrecon.batch.children import close_forkers
from gnrecon.batch.execute import run_job
from gnrecon.batch.job import Job
from gnrecon.batch.outcome import Outcome


def run_locally(jobs: Sequence[Job], count: int, devices: Sequence[str], done: Callable[[Outcome], None]) -> None:
    """Do jobs, `count` at a time, each in a process of its own.

    Whatever ends this function early, such as Ctrl-C, ends the processes, too.

    Parameters
    ----------
    jobs : in the order in which they are begun
    count : at a time
    devices : CUDA devices, as ``CUDA_VISIBLE_DEVICES`` names them, that jobs take in turn; none: whatever is there
    done : told each outcome, in the order in which they come
    """
    stop, seats = threading.Event(), _Seats(count, devices)

    def one(job: Job) -> Outcome:
        with seats.taken() as environment:
            return run_job(job, stop, environment)

    try:
        with ThreadPoolExecutor(count, thread_name_prefix="gnrecon-job") as pool:
            futures = [pool.submit(one, job) for job in jobs]
            try:
                for future in as_completed(futures):
                    done(future.result())
            except BaseException:
                stop.set()
                for future in futures:
                    future.cancel()
                raise
    finally:
        close_forkers()


class _Seats:
    """As many places as jobs may run at a time, each with a device."""

    def __init__(self, count: int, devices: Sequence[str]) -> None:
        self._free: SimpleQueue[dict[str, str]] = SimpleQueue()
        for number in range(count):
            self._free.put({"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]} if devices else {})

    @contextmanager
    def taken(self) -> Iterator[dict[str, str]]:
        environment = self._free.get()
        try:
            yield environment
        finally:
            self._free.put(environment)
