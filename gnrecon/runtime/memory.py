"""Peak resident memory of the process, as a whole and within a block of code.

Linux keeps a high-water mark, VmHWM in /proc/self/status, and resets it to the current resident memory when 5 is
written to /proc/self/clear_refs (manual page proc_pid_clear_refs(5)). There is one mark for the whole process, so
before each reset its value is passed to all blocks that are being measured, in other threads too. Programs that read
the peak afterwards, such as ``time -v``, see only that since the last reset.

Where the mark cannot be reset, as on other systems and in some containers, a thread samples resident memory 20 times a
second. It misses peaks between two samples unless they raise the high-water mark.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Self

_lock = Lock()
_active: list[PeakMemory] = []
_highest = 0  # highest mark ever read, because a reset loses it


class PeakMemory:
    """Measures the peak resident memory while the block runs; `mb` is the peak in MB of 10^6 bytes.

    `sampled` says whether the peak was sampled, so that it may be too low.

    Parameters
    ----------
    interval_seconds : time between samples where the mark cannot be reset
    """

    def __init__(self, *, interval_seconds: float = 0.05) -> None:
        self.sampled = False
        self._interval_seconds = interval_seconds
        self._peak, self._mark = 0, 0
        self._ended = Event()
        self._sampler: Thread | None = None

    @property
    def mb(self) -> float:
        """The peak so far or, after the block, within it, in MB."""
        return _mb(self._peak)

    def __enter__(self) -> Self:
        with _lock:
            mark = _read_mark()
            self.sampled = not _reset_mark()
            self._mark = mark
            _active.append(self)
        if self.sampled:
            self._sampler = Thread(target=self._sample, daemon=True)
            self._sampler.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._sampler is not None:
            self._sampler.join()
        with _lock:
            mark = _read_mark()
            _active.remove(self)
            # Without a reset, a mark that has risen is the peak as well.
            self._note(mark if not self.sampled or mark > self._mark else _resident())

    def _note(self, size: int) -> None:
        self._peak = max(self._peak, size)

    def _sample(self) -> None:
        self._note(_resident())
        while not self._ended.wait(self._interval_seconds):
            self._note(_resident())


def process_peak_mb() -> float:
    """Return the process's peak resident memory since its start, in MB of 10^6 bytes."""
    with _lock:
        _read_mark()
        return _mb(_highest)


def _read_mark() -> int:
    """Return the high-water mark in bytes, and pass it to all active measurements that rely on it."""
    global _highest
    mark = _high_water()
    _highest = max(_highest, mark)
    for measurement in _active:
        if not measurement.sampled:
            measurement._note(mark)
    return mark


def _high_water() -> int:
    # Preferred over `getrusage`, whose peak includes the parent process before the exec.
    found = status_bytes("VmHWM")
    if found is not None:
        return found
    # Kilobytes on Linux, bytes on macOS.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def status_bytes(name: str, *, path: Path = Path("/proc/self/status")) -> int | None:
    """Return a size of /proc/self/status in bytes, or None where there is none."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")), None)


def _resident() -> int:
    import psutil

    return int(psutil.Process().memory_info().rss)


def _reset_mark(*, path: Path = Path("/proc/self/clear_refs")) -> bool:
    """Reset the high-water mark to the current resident memory; return whether that was possible."""
    try:
        path.write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _mb(size: int) -> float:
    return round(size / 1e6, 1)
