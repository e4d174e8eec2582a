"""How many scans a machine takes at a time, by its cores, its free memory and its GPUs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil

from gnrecon.batch.job import Job
from gnrecon.options import Options
from gnrecon.report.estimate import estimate

_CGROUP = Path("/sys/fs/cgroup")
_UNKNOWN_MB = 2000.0
"""Of memory for a run that nothing is known of before."""

_BYTES_A_POINT = 12
"""Of the densest common storage, three floats."""


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
