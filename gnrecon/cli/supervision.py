"""Runs the rest of a command in a child process, where a limit of memory may end it in native code, without a word.

Native code that finds no memory aborts, exits by itself, or asks again for ever, as OpenBLAS does. The parent stays
small, waits, passes signals on, ends what asks for ever, and reports such an end by one sentence and the exit code for
memory.
"""

from __future__ import annotations

import atexit
import os
import resource
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.interrupts import die_with_parent

PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def continue_in_child(memory_mb: float | None = None) -> None:
    """Fork: the child returns and goes on; the parent waits for its end and exits as it did.

    To be called before numerical libraries have started threads.

    Parameters
    ----------
    memory_mb : limit of the resident memory of the child and its descendants, in MB of 10^6 bytes, if any

    Raises
    ------
    SystemExit
        In the parent, with the exit code of the child, or `ExitCode.MEMORY` where a limit of memory ended it.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    ended, ending = os.pipe()
    # A signal that comes before the parent can pass it on waits until it can.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)
    parent, child = os.getpid(), os.fork()
    if child == 0:
        os.close(ended)
        die_with_parent(parent)
        atexit.register(os.write, ending, b".")  # an exit by native code does not get there
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return
    os.close(ending)
    waiting = _Waiting(child, ended, memory_mb)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    raise SystemExit(waiting.exit_code())


class _Waiting:
    """Waits for a child, to which it passes signals on from its creation.

    Parameters
    ----------
    child : process
    ended : pipe into which the child writes when Python has ended it
    memory_mb : its limit of resident memory, or None
    """

    def __init__(self, child: int, ended: int, memory_mb: float | None) -> None:
        self._child, self._ended, self._memory_mb = child, ended, memory_mb
        self._watch = _AllocationWatch(child)
        for number in PASSED_ON:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._pass_on)

    def exit_code(self, *, poll_seconds: float = 0.05) -> int:
        """Wait, and return the exit code of this process; an end for lack of memory is printed."""
        while True:
            pid, status = os.waitpid(self._child, os.WNOHANG)
            if pid:
                return self._code(os.waitstatus_to_exitcode(status))
            if self._memory_mb is not None and (used := _resident_mb(self._child)) > self._memory_mb:
                self._end_tree()
                os.waitpid(self._child, 0)
                limit = f"the limit is {self._memory_mb:,.0f} MB (--memory)"
                return _out_of_memory(f"The run needed {used:,.0f} MB of memory; {limit}.")
            self._watch.end_stuck()
            time.sleep(poll_seconds)

    def _code(self, status: int) -> int:
        if status >= 0 and (status == ExitCode.OK or os.read(self._ended, 1)):
            return status
        if -status in PASSED_ON:
            return ExitCode.INTERRUPTED
        how = f"signal {-status}" if status < 0 else f"exit code {status}"
        return _out_of_memory(f"Native code ended the run by {how}, most likely because a limit left it no memory.")

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        """Pass a signal on; Ctrl-C on a terminal has reached the child already."""
        del frame
        if number != signal.SIGINT or not sys.stdin.isatty():
            with suppress(ProcessLookupError):
                os.kill(self._child, number)

    def _end_tree(self) -> None:
        import psutil

        with suppress(psutil.Error):
            process = psutil.Process(self._child)
            for one in [*process.children(recursive=True), process]:
                with suppress(psutil.Error):
                    one.kill()


@dataclass(frozen=True)
class _Usage:
    """What a process has used: its addresses in bytes, its page faults, and ticks of processor time by itself and by
    the system on its behalf."""

    addresses: int
    faults: int
    own_ticks: int
    system_ticks: int

    @classmethod
    def of(cls, pid: int) -> _Usage:
        """Read it from /proc, see the manual page proc_pid_stat(5).

        Raises
        ------
        OSError
            When the process has ended.
        """
        # The name, in parentheses, may hold spaces; the state follows, which is the third field.
        words = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        minor, major, own, system, addresses = (int(words[field - 3]) for field in (10, 12, 14, 15, 23))
        return cls(addresses, minor + major, own, system)


class _AllocationWatch:
    """Ends descendants that ask in vain, again and again, for memory that the shell's limit does not leave.

    Such a process spends its time in the system without a page fault, close below the limit. It is ended as an abort
    would end it, which a batch knows as a lack of memory.

    Parameters
    ----------
    child : process, which counts with its descendants
    """

    def __init__(self, child: int) -> None:
        self._child = child
        self._limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        self._before: dict[int, _Usage] = {}
        self._next = time.monotonic()

    def end_stuck(self, *, interval_seconds: float = 3.0) -> None:
        """Look at all processes, at most once in an interval, and end those that were stuck during all of it."""
        if self._limit == resource.RLIM_INFINITY or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + interval_seconds
        now: dict[int, _Usage] = {}
        for pid in (self._child, *_descendants(self._child)):
            with suppress(OSError, ValueError):
                now[pid] = _Usage.of(pid)
                if pid in self._before and self._is_stuck(self._before[pid], now[pid]):
                    os.kill(pid, signal.SIGABRT)
        self._before = now

    def _is_stuck(
        self,
        before: _Usage,
        after: _Usage,
        *,
        most_free_bytes: int = 1 << 26,
        least_ticks: int = 20,
        ratio: float = 3.0,
    ) -> bool:
        """Whether nothing but failed allocations explains what a process has used meanwhile.

        Parameters
        ----------
        before, after : at the ends of the interval
        most_free_bytes : below the limit; OpenBLAS asks for half of this
        least_ticks : time in the system, a fifth of a second
        ratio : of the time in the system to the process's own; measured: 9
        """
        system, own = after.system_ticks - before.system_ticks, after.own_ticks - before.own_ticks
        return (
            after.addresses == before.addresses > self._limit - most_free_bytes
            and after.faults == before.faults
            and system >= least_ticks
            and system > ratio * own
        )


def _descendants(pid: int) -> list[int]:
    import psutil

    with suppress(psutil.Error):
        return [process.pid for process in psutil.Process(pid).children(recursive=True)]
    return []


def _resident_mb(pid: int) -> float:
    import psutil

    total = 0
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        for one in [process, *process.children(recursive=True)]:
            with suppress(psutil.Error):
                total += one.memory_info().rss
    return total / 1e6


def _out_of_memory(sentence: str) -> int:
    print(f"gnrecon: {sentence}", file=sys.stderr)
    return ExitCode.MEMORY
