"""Runs the jobs of a batch: in processes of this machine, or on a Dask cluster.

`run_locally` is the default. `run_on_cluster` submits the same function as Dask tasks, so that each scan has a process
of its own with its limits wherever it runs. `fitting_jobs` says how many jobs a machine takes at a time.
"""

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

from gnrecon.batch.child_process import close_fork_servers
from gnrecon.batch.execute import run_job
from gnrecon.batch.job import Cause, Job, JobOutcome, Status, running_folder
from gnrecon.options import Options
from gnrecon.report.estimate import estimate
from gnrecon.runtime.dask_scheduler import dask_client, require_distributed
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.interrupts import ignore_interrupts
from gnrecon.runtime.memory_budget import available_memory_mb


def run_locally(jobs: Sequence[Job], count: int, devices: Sequence[str], done: Callable[[JobOutcome], None]) -> None:
    """Run jobs, `count` at a time, each in a process of its own.

    An exception that ends this function early, such as Ctrl-C, also ends the processes.

    Parameters
    ----------
    jobs : in the order in which they are started
    count : at a time
    devices : CUDA devices, as ``CUDA_VISIBLE_DEVICES`` names them, that jobs take in turn; empty: all devices
    done : called with each outcome, as they come
    """
    stop, pool_of_devices = threading.Event(), _DevicePool(count, devices)

    def run(job: Job) -> JobOutcome:
        with pool_of_devices.borrowed() as environment:
            return run_job(job, stop, environment)

    try:
        with ThreadPoolExecutor(count, thread_name_prefix="gnrecon-job") as pool:
            try:
                for future in as_completed([pool.submit(run, job) for job in jobs]):
                    done(future.result())
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    ignore_interrupts()  # a second one would leave processes, and the batch without its summary
                stop.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
        close_fork_servers()


class _DevicePool:
    """One slot for each job that may run at a time, with the environment that names its device."""

    def __init__(self, count: int, devices: Sequence[str]) -> None:
        self._free: SimpleQueue[dict[str, str]] = SimpleQueue()
        for number in range(count):
            self._free.put({"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]} if devices else {})

    @contextmanager
    def borrowed(self) -> Iterator[dict[str, str]]:
        environment = self._free.get()
        try:
            yield environment
        finally:
            self._free.put(environment)


# Dask gives the tasks of a lost worker to others. Each task first reads the scan's record in the output folder, so that
# nothing finished is done twice. All workers must see the scans and the outputs by the same paths.


def run_on_cluster(
    jobs: Sequence[Job],
    address: str | None,
    count: int,
    devices: Sequence[str],
    done: Callable[[JobOutcome], None],
    work: str | None = None,
    *,
    retries: int = 2,
) -> None:
    """Run jobs on a Dask cluster, as many at a time as its workers have threads.

    An exception that ends this function early, such as Ctrl-C, also ends the running scans.

    Parameters
    ----------
    jobs : in the order in which they are submitted
    address : of a scheduler, such as ``tcp://host:8786``; None: a cluster of this machine's processes
    count : of local workers
    devices : CUDA devices that local workers take in turn
    done : called with each outcome, as they come
    work : module of the work, see `run_job`
    retries : how often Dask repeats a task that raised an error, as on a worker without the libraries

    Raises
    ------
    UsageError
        When Dask is not installed, or the scheduler does not answer.
    """
    distributed = require_distributed()
    with _client(distributed, address, count) as client, client.as_current(), _alive_file(jobs[0].output) as alive:
        futures = {}
        for job in jobs:
            task = replace(job, scan=job.scan.absolute(), output=job.output.absolute())
            # A unique key, because Dask returns the stored result of an equal key, such as that of an earlier batch.
            key = f"gnrecon-{job.name}-{secrets.token_hex(4)}"
            futures[client.submit(run_on_worker, task, alive, list(devices), work, key=key, retries=retries)] = job
        try:
            for future in distributed.as_completed(list(futures)):
                error = future.exception() if future.status != "finished" else None
                done(_lost(futures[future], error) if error is not None else future.result())
        except BaseException:
            client.cancel(list(futures))
            raise


def run_on_worker(job: Job, alive: Path, devices: list[str], work: str | None) -> JobOutcome:
    """Run a job on a Dask worker, until the batch removes the file that marks it as alive."""
    from distributed import get_worker

    name = get_worker().name
    environment = {}
    if devices and isinstance(name, int) and "CUDA_VISIBLE_DEVICES" not in os.environ:
        environment = {"CUDA_VISIBLE_DEVICES": devices[name % len(devices)]}
    return run_job(job, FileRemoved(alive), environment, work)


class FileRemoved:
    """A stop signal that is set once a file that existed is gone."""

    def __init__(self, path: Path) -> None:
        self._path, self._seen = path, False

    def is_set(self) -> bool:
        """Whether the file is gone; one that was never seen may only be late on a network file system."""
        exists = self._path.exists()
        self._seen |= exists
        return self._seen and not exists


@contextmanager
def _client(distributed: Any, address: str | None, count: int) -> Iterator[Any]:
    if address is not None:
        with dask_client(address) as client:
            yield client
        return
    # Each job has its own memory limit, and a local cluster needs no dashboard.
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
def _alive_file(output: Path) -> Iterator[Path]:
    """A file that exists as long as the batch runs."""
    running = running_folder(output.absolute())
    running.mkdir(parents=True, exist_ok=True)
    path = running / f".batch-{secrets.token_hex(6)}"
    path.touch()
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def _lost(job: Job, error: BaseException) -> JobOutcome:
    """The outcome of a job that Dask gave up, for example after several workers were lost while running it."""
    sentence = f"The cluster gave it up: {type(error).__name__}: {error}".splitlines()[0]
    return JobOutcome(job.name, str(job.scan), Status.FAILED, Cause.UNFORESEEN, sentence, ExitCode.UNFORESEEN)


def fitting_jobs(jobs: Sequence[Job], threads: int, *, usable_memory_share: float = 0.9) -> int:
    """Return how many of the jobs the machine takes at a time, by its cores and its free memory.

    Parameters
    ----------
    jobs : to be done
    threads : of each
    usable_memory_share : of the free memory that jobs may fill; the rest is left to the system
    """
    by_cores = available_cores() // threads
    by_memory = int(usable_memory_share * available_memory_mb() / max(map(_needed_mb, jobs)))
    return max(1, min(by_cores, by_memory, len(jobs)))


def available_cores() -> int:
    """Return the cores that this process may use, by affinity and by the quota of its control group."""
    cores = len(os.sched_getaffinity(0))
    with suppress(OSError, ValueError):
        quota, period = _read_cgroup("cpu.max").split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return cores


def _read_cgroup(name: str) -> str:
    return Path("/sys/fs/cgroup", name).read_text(encoding="ascii")


def _needed_mb(job: Job, *, unknown_run_mb: float = 2000.0, least_point_bytes: int = 12) -> float:
    """Return the memory limit of a job, or else what a run of as many points as its file may hold should need.

    Parameters
    ----------
    job : Job
    unknown_run_mb : for a run whose size cannot be estimated, in MB of 10^6 bytes
    least_point_bytes : of a point in the densest common storage, three floats
    """
    if job.limits.memory_mb is not None:
        return job.limits.memory_mb
    options = Options.of(**job.options)
    if options.edge_length is not None:  # needs the size of the shape, which is not known yet
        return unknown_run_mb
    size = job.scan.stat().st_size if job.scan.is_file() else 0
    points = min(options.read_points, size // least_point_bytes)
    expected = estimate(points, points, np.array([[-1.0] * 3, [1.0] * 3]), options)
    return unknown_run_mb if expected is None else expected.memory_mb


def cuda_devices(jobs: Sequence[Job]) -> list[str]:
    """Return the devices, as ``CUDA_VISIBLE_DEVICES`` names them, if a job uses ``cuda``; none otherwise.

    A job with a fixed device, such as ``cuda:1``, needs to see all devices; then none are assigned.
    """
    names = {str(job.options["device"]) for job in jobs}
    if "cuda" not in names or any(device.startswith("cuda:") for device in names):
        return []
    if visible := os.environ.get("CUDA_VISIBLE_DEVICES"):
        return [name.strip() for name in visible.split(",") if name.strip()]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]
