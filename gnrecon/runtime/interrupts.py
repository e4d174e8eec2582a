"""Ends a program politely: SIGTERM and SIGHUP do what Ctrl-C does, and no library may swallow it.

An interrupt is a `KeyboardInterrupt` in the main thread: temporary files are removed, a fit keeps its best field, and a
batch writes its summary. Libraries that read files catch even that, with ``except BaseException``. So interrupts
are counted, and `reraised` raises one again that a block of third-party code has lost.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn


class _Received:
    """Counts the interrupts of this process."""

    count = 0


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    del number, frame
    _Received.count += 1
    raise KeyboardInterrupt


@contextmanager
def polite_ends() -> Iterator[None]:
    """Let SIGTERM, SIGHUP and SIGINT raise `KeyboardInterrupt` while the block runs in the main thread.

    A signal that is ignored stays ignored, as SIGHUP is under ``nohup``, and SIGINT in a shell's background.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, _interrupt)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
