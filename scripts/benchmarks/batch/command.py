"""The command line in processes of its own, and what they cost."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gnrecon


@dataclass(frozen=True)
class Cost:
    """What a command took: its exit code, seconds, and processor seconds of all its processes together.

    `disturbed` says whether the deed was done.
    """

    exit_code: int
    seconds: float
    cpu_seconds: float
    disturbed: bool = False


def run(*words: str, deed: Callable[[int], bool] | None = None) -> Cost:
    """Run ``gnrecon`` with some words to its end.

    Parameters
    ----------
    deed : tried now and then with the process's number, until it says that it is done
    """
    environment = os.environ | {"PYTHONPATH": str(Path(str(gnrecon.__file__)).parents[1])}
    before, start = _children_cpu(), time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "gnrecon", *words],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    disturbed = False
    while process.poll() is None:
        disturbed = disturbed or (deed is not None and deed(process.pid))
        time.sleep(0.05)
    return Cost(process.returncode, time.perf_counter() - start, _children_cpu() - before, disturbed)


def _children_cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
