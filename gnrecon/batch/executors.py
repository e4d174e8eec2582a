"""The default engine: processes of this machine, several at a time."""

from __future__ import annotations

import logging
import os
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import psutil

from gnrecon.batch.child_process import WORK, close_forkers
from gnrecon.batch.execute import run_job
from gnrecon.batch.job import Cause, Job, Outcome, Status, running_folder
from gnrecon.options import Options
from gnrecon.report.estimate import estimate
from gnrecon.runtime.dask_scheduler import dask_client, require_distributed
from gnrecon.runtime.errors import ExitCode


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


RETRIES = 2
"""How often Dask begins a task again that raised an error, as a worker without the libraries would."""


# The same jobs on a Dask cluster: one that is there already, or one of local processes.
#
# A task of the cluster is the very function that local jobs are, so that each scan has a process of its own with its
# limits wherever it runs. Dask gives the tasks of a lost worker to others; a task first looks at the scan's record,
# which lies beside the outputs, so that nothing finished is done twice. All workers must see the scans and the outputs
# by the same paths.


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
        with dask_client(address) as client:
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


_CGROUP = Path("/sys/fs/cgroup")

_UNKNOWN_MB = 2000.0
"""Of memory for a run that nothing is known of before."""

_BYTES_A_POINT = 12
"""Of the densest common storage, three floats."""


# How many scans a machine takes at a time, by its cores, its free memory and its GPUs.


def fitting_jobs(jobs: Sequence[Job], threads: int) -> int:
    """Return how many of the jobs the machine takes at a time.

    Parameters
    ----------
    jobs : that are to be done
    threads : of each
    """
    by_cores = available_cores() // threads
    by_memory = int(0.9 * available_memory_mb() / max(map(_needed_mb, jobs)))
    return max(1, min(by_cores, by_memory, len(jobs)))


def available_cores() -> int:
    """Return the cores that this process may use, by affinity and by the quota of its control group."""
    cores = len(os.sched_getaffinity(0))
    with suppress(OSError, ValueError):
        quota, period = (_CGROUP / "cpu.max").read_text(encoding="ascii").split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return cores


def available_memory_mb() -> float:
    """Return the memory that is free, in MB of 10^6 bytes, within the limit of the control group."""
    free = int(psutil.virtual_memory().available)
    with suppress(OSError, ValueError):
        limit = int((_CGROUP / "memory.max").read_text(encoding="ascii"))
        free = min(free, limit - int((_CGROUP / "memory.current").read_text(encoding="ascii")))
    return free / 1e6


def _needed_mb(job: Job) -> float:
    """The limit of a job's memory, or what a run of as many points as its file may hold is expected to need."""
    if job.limits.memory_mb is not None:
        return job.limits.memory_mb
    options = Options.of(**job.options)
    if options.edge_length is not None:  # the size of the shape is not known before
        return _UNKNOWN_MB
    size = job.scan.stat().st_size if job.scan.is_file() else 0
    points = min(options.read_points, size // _BYTES_A_POINT)
    expected = estimate(points, points, np.array([[-1.0] * 3, [1.0] * 3]), options)
    return _UNKNOWN_MB if expected is None else expected.memory_mb


# Which CUDA devices there are, so that each job can be given one of them.


def cuda_devices(jobs: Sequence[Job]) -> list[str]:
    """Return the devices, as ``CUDA_VISIBLE_DEVICES`` names them, if a job asks for ``cuda``; none otherwise.

    A job that asks for a certain one, such as ``cuda:1``, needs to see them all; then none are handed out.
    """
    wanted = {str(job.options["device"]) for job in jobs}
    if "cuda" not in wanted or any(device.startswith("cuda:") for device in wanted):
        return []
    if visible := os.environ.get("CUDA_VISIBLE_DEVICES"):
        return [name.strip() for name in visible.split(",") if name.strip()]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]
