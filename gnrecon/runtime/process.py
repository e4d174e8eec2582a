"""What a process of the command line sets for the libraries that it loads, and how it ends.

All of it holds for the whole process. So it is for the command line, and not for the Python library, which runs in
other programs' processes.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import sys
import threading
from collections.abc import MutableMapping
from contextlib import suppress
from typing import NoReturn


def settle_process(environment: MutableMapping[str, str], *, arenas: int = 2, garbage_threshold: int = 400_000) -> None:
    """Set how threads wait and how memory is kept, before numpy and torch are loaded.

    Parameters
    ----------
    environment : variables of this process; those that the user has set stay, and child processes inherit all
    arenas : most heaps of glibc's malloc. Each keeps what was freed in it, and by default each thread has its own; they
        rarely wait for each other, because each thread keeps small pieces for itself
    garbage_threshold : new objects after which Python looks for garbage; imports make 350,000 objects and none
    """
    # On a busy machine, threads that spin while they wait slow the run down several times.
    environment.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if "MALLOC_ARENA_MAX" not in environment:
        environment["MALLOC_ARENA_MAX"] = str(arenas)  # which child processes read
        _limit_arenas(arenas)
    gc.set_threshold(garbage_threshold)


def _limit_arenas(most: int, *, m_arena_max: int = -8) -> None:
    """Limit the heaps of this process, where its C library is glibc; `m_arena_max` is the number of its option."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(m_arena_max, most)


def end_process(code: int) -> NoReturn:
    """Exit without taking the libraries' objects apart, which takes longer than a small command.

    What is registered for the exit runs, and the standard streams are flushed. Where a thread still works, or a
    debugger or profiler watches, Python exits as usual.
    """
    working = [thread for thread in threading.enumerate() if not (thread.daemon or thread is threading.main_thread())]
    if working or sys.gettrace() is not None or sys.getprofile() is not None:
        sys.exit(code)
    atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):  # None where the process began without it
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
