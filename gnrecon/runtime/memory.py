"""The greatest resident memory of the process, as a whole and within a stretch of work.

Linux keeps a high-water mark, VmHWM in /proc/self/status, and sets it back to what is resident now when 5 is written to
/proc/self/clear_refs (manual page proc_pid_clear_refs(5)). The mark is one for the whole process, so every reading is
told to all stretches that are being watched, in other threads too, before it is set back. Programs that ask the system
for the peak afterwards, as ``time -v`` does, then see that of the last stretch only.

Where the mark cannot be set back, as on other systems and in some containers, a thread samples resident memory 20 times
a second; what comes and goes between two samples is missed unless it raises the high-water mark.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Self

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
INTERVAL = 0.05
"""Seconds between samples."""

_lock = Lock()
_watched: list[PeakMemory] = []
_highest = 0
"""Greatest mark that was ever read, because setting it back forgets it."""


class PeakMemory:
    """Watches the process's resident memory while the block runs; `mb` is the peak in it, in MB of 10^6 bytes.

    `sampled` says whether the peak was sampled, so that it may be too small.
    """

    def __init__(self) -> None:
        self.sampled = False
        self._peak, self._mark = 0, 0
        self._ended = Event()
        self._sampler: Thread | None = None

    @property
    def mb(self) -> float:
        """The peak until now or, after the block, within it, in MB."""
        return _mb(self._peak)

    def __enter__(self) -> Self:
        with _lock:
            mark = _read_mark()
            self.sampled = not _reset_mark()
            self._mark = mark
            _watched.append(self)
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
            _watched.remove(self)
            # A mark that was not set back tells the peak all the same where it has risen.
            self._note(mark if not self.sampled or mark > self._mark else _resident())

    def _note(self, size: int) -> None:
        self._peak = max(self._peak, size)

    def _sample(self) -> None:
        self._note(_resident())
        while not self._ended.wait(INTERVAL):
            self._note(_resident())


def process_peak_mb() -> float:
    """Return the process's greatest resident memory since it began, in MB of 10^6 bytes."""
    with _lock:
        _read_mark()
        return _mb(_highest)


def _read_mark() -> int:
    """Return the high-water mark in bytes, having told all that are being watched exactly."""
    global _highest
    mark = _high_water()
    _highest = max(_highest, mark)
    for watched in _watched:
        if not watched.sampled:
            watched._note(mark)
    return mark


def _high_water() -> int:
    # Unlike VmHWM, the peak of `getrusage` counts the program that started this one too, as it was then.
    found = _status("VmHWM")
    if found is not None:
        return found
    # Kilobytes on Linux, bytes on macOS.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _status(name: str) -> int | None:
    """Return a size of /proc/self/status in bytes, or None where there is none."""
    try:
        lines = STATUS.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")), None)


def _resident() -> int:
    import psutil

    return int(psutil.Process().memory_info().rss)


def _reset_mark() -> bool:
    """Set the high-water mark back to what is resident; return whether that was possible."""
    try:
        RESET.write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _mb(size: int) -> float:
    return round(size / 1e6, 1)
