"""Ends a program politely: SIGTERM and SIGHUP do what Ctrl-C does, and no library may swallow it.

An interrupt is a `KeyboardInterrupt` in the main thread: temporary files are removed, a fit keeps its best field, and a
batch writes its summary. Libraries that read files catch even that, with ``except BaseException``. So interrupts
are counted, and `reraised` raises one again that a block of third-party code has lost.

Signals that follow at once count as the same interrupt: ``timeout``, systemd and terminals send several. Those that
come when the results are complete have no effect, so that no file lacks its companions and no end contradicts them.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class _Received:
    """The interrupts of this process: how many, when the latest came, and whether they still have an effect.

    While blocks of `postponed_interrupts` run, whose number is `blocks`, the signal that came last waits.
    """

    count = 0
    latest_seconds = -math.inf
    ignored = False
    blocks = 0
    waiting: int | None = None


def _interrupt(number: int, frame: FrameType | None, *, same_seconds: float = 0.5) -> None:
    """Raise an interrupt; within `same_seconds`, in which a run cleans up, further signals are the same one."""
    del frame
    if _Received.blocks:
        _Received.waiting = number
        return
    now = time.monotonic()
    if _Received.ignored or now - _Received.latest_seconds < same_seconds:
        return
    _Received.count, _Received.latest_seconds = _Received.count + 1, now
    raise KeyboardInterrupt


@contextmanager
def polite_ends(*, process_ends: bool = False) -> Iterator[None]:
    """Let SIGTERM, SIGHUP and SIGINT raise `KeyboardInterrupt` while the block runs in the main thread.

    A signal that is ignored stays ignored, as SIGHUP is under ``nohup``, and SIGINT in a shell's background.

    Parameters
    ----------
    process_ends : whether the process exits after the block; signals that come while it does are then ignored
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    _Received.ignored, _Received.latest_seconds = False, -math.inf
    try:
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, _interrupt)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if process_ends else handler)
        # Python ends itself by SIGINT, whatever the exit code, where the last text it ran, such as one that makes a
        # dataclass, was interrupted.
        eval("0")


def ignore_interrupts() -> None:
    """Ignore interrupts until the end of `polite_ends`: the results are complete, and what is left takes moments."""
    _Received.ignored = True


@contextmanager
def postponed_interrupts() -> Iterator[None]:
    """Postpone interrupts to the end of a block in which native code would abort if Python raised an exception."""
    _Received.blocks += 1
    try:
        yield
    finally:
        _Received.blocks -= 1
        if _Received.waiting is not None and not _Received.blocks:
            number, _Received.waiting = _Received.waiting, None
            signal.raise_signal(number)  # its handler raises in the main thread, whichever thread this is


@contextmanager
def reraised() -> Iterator[None]:
    """Raise `KeyboardInterrupt` at the end of a block in which one was received, whatever the block made of it."""
    before = _Received.count
    try:
        yield
    except Exception as error:
        if _Received.count > before:
            raise KeyboardInterrupt from error
        raise
    if _Received.count > before:
        raise KeyboardInterrupt


def die_with_parent(parent: int) -> None:
    """Let the system kill this process when its parent ends; where the parent has already ended, exit now."""
    pr_set_pdeathsig = 1  # from linux/prctl.h
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
