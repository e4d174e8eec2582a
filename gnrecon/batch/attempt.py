"""One attempt at a piece of work in a child process, within limits of time and memory.

Memory is watched from outside, as the resident memory of the child and all that it has started: a limit of address
space (``RLIMIT_AS``) would also count what torch and CUDA merely reserve.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from gnrecon.batch.children import WORK, Child, ForkerError, start_child
from gnrecon.batch.job import Limits, Stop
from gnrecon.batch.outcome import Cause, cause_of, describe_signal
from gnrecon.runtime.errors import ExitCode

LOOK = 0.1
"""Seconds between two looks at a child."""

_SELDOM = 10
"""Looks between two searches for what a child has started."""

_PATIENCE = 5.0


@dataclass(frozen=True)
class End:
    """How an attempt ended.

    Parameters
    ----------
    cause : why it failed; None where it went well
    exit_code : of the child; None where it was ended for another reason than its memory
    message : a sentence, where the child itself could not say one
    peak_memory_mb : greatest resident memory that was seen, in MB of 10^6 bytes
    seconds : from the child's start to its end
    """

    cause: Cause | None
    exit_code: int | None
    message: str
    peak_memory_mb: float
    seconds: float


def attempt(
    argument: Mapping[str, Any],
    *,
    threads: int,
    log: Path,
    environment: Mapping[str, str],
    limits: Limits,
    stop: Stop | None = None,
    work: str = WORK,
) -> End:
    """Do a piece of work in a child process and wait for its end, or bring it about.

    Where the process that starts the children was itself ended from outside, it is started again, and so is the work.

    Parameters
    ----------
    argument : of the work, plain values
    threads : of the numerical libraries
    log : file for what the child says
    environment : variables that the child is to have
    limits : Limits
    stop : set by the caller when the child is to end now
    work : module with ``work(argument) -> exit code``

    Raises
    ------
    ForkerError
        When no child can be started, or the process that starts them has ended twice.
    """
    once = partial(_once, argument, threads, log, environment, limits, stop or threading.Event(), work)
    try:
        return once()
    except ForkerError:
        return once()


def _once(
    argument: Mapping[str, Any],
    threads: int,
    log: Path,
    environment: Mapping[str, str],
    limits: Limits,
    stop: Stop,
    work: str,
) -> End:
    with start_child(threads, argument, log, environment, work) as child:
        start, peak, watched = time.monotonic(), 0.0, Watched(child.pid)
        while (status := child.wait(LOOK)) is None:
            memory, seconds = watched.memory_mb(), round(time.monotonic() - start, 3)
            peak = max(peak, round(memory, 1))
            if stop.is_set():
                return _killed(child, End(Cause.INTERRUPTED, ExitCode.INTERRUPTED, "Interrupted.", peak, seconds))
            if limits.memory_mb is not None and memory > limits.memory_mb:
                said = f"It needed {memory:,.0f} MB of memory; the limit is {limits.memory_mb:,.0f} MB (--memory)."
                return _killed(child, End(Cause.MEMORY, ExitCode.MEMORY, said, peak, seconds))
            if limits.seconds is not None and seconds > limits.seconds:
                said = f"It had not ended after {limits.seconds:g} s, which is the limit (--timeout)."
                return _killed(child, End(Cause.TIMEOUT, None, said, peak, seconds))
        seconds = round(time.monotonic() - start, 3)
    message = describe_signal(-status) if status < 0 else ""
    return End(cause_of(status), status, message, peak, seconds)


def _killed(child: Child, end: End) -> End:
    """Kill a child with all that it has started, and wait until it has gone."""
    for process in _tree(child.pid):
        with suppress(psutil.Error):
            process.kill()
    with suppress(ForkerError):
        child.wait(_PATIENCE)
    return end


class Watched:
    """A process whose memory is looked at again and again.

    What it has started is looked for now and then only, because that takes a look at every process of the machine.
    """

    def __init__(self, pid: int) -> None:
        self._pid, self._looks = pid, 0
        self._tree: list[psutil.Process] = []

    def memory_mb(self) -> float:
        """Return the resident memory of it and its descendants, in MB of 10^6 bytes; 0 when it has ended."""
        if self._looks % _SELDOM == 0:
            self._tree = _tree(self._pid)
        self._looks += 1
        total = 0
        for process in self._tree:
            with suppress(psutil.Error):
                total += process.memory_info().rss
        return total / 1e6


def _tree(pid: int) -> list[psutil.Process]:
    try:
        process = psutil.Process(pid)
        return [process, *process.children(recursive=True)]
    except psutil.Error:
        return []
