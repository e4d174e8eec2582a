"""The same jobs on a Dask cluster: one that is there already, or one of local processes.

A task of the cluster is the very function that local jobs are, so that each scan has a process of its own with its
limits wherever it runs. Dask gives the tasks of a lost worker to others; a task first looks at the scan's record, which
lies beside the outputs, so that nothing finished is done twice. All workers must see the scans and the outputs by the
same paths.
"""

from __future__ import annotations

import logging
import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from gnrecon.batch.children import WORK
from gnrecon.batch.execute import run_job
from gnrecon.batch.job import Job, running_folder
from gnrecon.batch.outcome import Cause, Outcome, Status
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.parallel import connected, require_distributed

RETRIES = 2
"""How often Dask begins a task again that raised an error, as a worker without the libraries would."""


def run_on_cluster(
    jobs: Sequence[Job],
    address: str | None,
    count: int,
    devices: Sequence[str],
    done: Callable[[Outcome], None],
    work: str = WORK,
) -> None:
    """Do jobs on a cluster, as many at a time as its workers have threads.

    Whatever ends this function early, such as Ctrl-C, ends the running scans, too.

    Parameters
    ----------
    jobs : in the order in which they are handed in
    address : of a scheduler, such as ``tcp://host:8786``; None: a cluster of this machine's processes
    count : of local workers
    devices : CUDA devices that local workers take in turn
    done : told each outcome, in the order in which they come
    work : module of the work, see `run_job`

    Raises
    ------
    UsageError
        When Dask is not installed, or the scheduler does not answer.
    """
    distributed = require_distributed()
    with _client(distributed, address, count) as client, client.as_current(), _sign(jobs[0].output) as sign:
        futures = {}
        for job in jobs:
            there = replace(job, scan=job.scan.absolute(), output=job.output.absolute())
            key = f"gnrecon-{job.name}-{secrets.token_hex(4)}"
            futures[client.submit(on_worker, there, sign, list(devices), work, key=key, retries=RETRIES)] = job
        try:
            for future in distributed.as_completed(list(futures)):
                error = future.exception() if future.status != "finished" else None
                done(_lost(futures[future], error) if error is not None else future.result())
        except BaseException:
            client.cancel(list(futures))
            raise


def on_worker(job: Job, sign: Path, devices: list[str], work: str) -> Outcome:
    """Do a job on a worker, until the batch takes its sign away."""
    from distributed import get_worker

    name = get_worker().name
    environment = {}
    if devices and isinstance(name, int) and "CUDA_VISIBLE_DEVICES" not in os.environ:
        environment = {"CUDA_VISIBLE_DEVICES": devices[name % len(devices)]}
    return run_job(job, Abandoned(sign), environment, work)


class Abandoned:
    """Set when a file is gone that was there before."""

    def __init__(self, sign: Path) -> None:
        self._sign, self._seen = sign, False

    def is_set(self) -> bool:
        """Whether the file is gone; one that was never seen may only be late, as network file systems are."""
        there = self._sign.exists()
        self._seen |= there
        return self._seen and not there


@contextmanager
def _client(distributed: Any, address: str | None, count: int) -> Iterator[Any]:
    if address is not None:
        with connected(address) as client:
            yield client
        return
    # The limits of memory are the jobs' own; a dashboard is for those who have a cluster of their own.
    with (
        distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def _sign(output: Path) -> Iterator[Path]:
    """A file that is there as long as the batch is."""
    running = running_folder(output.absolute())
    running.mkdir(parents=True, exist_ok=True)
    sign = running / f".batch-{secrets.token_hex(6)}"
    sign.touch()
    try:
        yield sign
    finally:
        sign.unlink(missing_ok=True)


def _lost(job: Job, error: BaseException) -> Outcome:
    """The outcome of a job that Dask gave up, as when it lost one worker after the other with it."""
    said = f"The cluster gave it up: {type(error).__name__}: {error}".splitlines()[0]
    return Outcome(job.name, str(job.scan), Status.FAILED, Cause.UNFORESEEN, said, ExitCode.UNFORESEEN)
