"""Scans of a batch that break in different ways, a watcher that crashes two of them, and the command in a process."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

import gnrecon
from gnrecon.batch.job import progress_file, records_folder, running_folder

BROKEN = {
    "torn": "input",
    "void": "input",
    "letter": "input",
    "killed": "signal",
    "hangs": "timeout",
    "hog": "memory",
}
"""Names of the broken scans, and the cause of failure that the batch must report."""

CONFIG = """widths = [200]
steps = 0
resolution = 32
timeout = "1h"
memory = "1500MB"

[scans."hangs.*"]
timeout = "20s"

[scans."hog.*"]
read-points = 6000000
"""
"""Configuration of the batch: fast fits, and limits. All points of the largest scan are read."""


def make_scans(folder: Path, good: int, *, points: int = 400, hog_points: int = 6_000_000) -> list[str]:
    """Fill a new folder with good scans and the broken ones; return the names of the good ones.

    Each scan has `points`, but the one that exceeds its memory has `hog_points`.
    """
    folder.mkdir()
    names = [f"torus-{number:02d}" for number in range(good)]
    for number, name in enumerate(names):
        rng = np.random.default_rng(number)
        write_ply(folder / f"{name}.ply", *torus(points, 0.25 + 0.2 * rng.random(), rng))
    whole = (folder / f"{names[0]}.ply").read_bytes()
    (folder / "torn.ply").write_bytes(whole[: len(whole) // 2])
    (folder / "void.ply").touch()
    (folder / "letter.txt").write_text("Dear reader,\nthis is a letter.\n", encoding="utf-8")
    for name in ("killed", "hangs"):
        (folder / f"{name}.ply").write_bytes(whole)
    write_ply(folder / "hog.ply", *torus(hog_points, 0.3, np.random.default_rng(0)))
    return names


def torus(count: int, tube: float, rng: np.random.Generator) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return points and normals, each of shape (count, 3), on a torus of radius 1."""
    u, v = rng.uniform(0, 2 * np.pi, (2, count)).astype(np.float32)
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    return np.column_stack([np.cos(u), np.sin(u), np.zeros_like(u)]) + np.float32(tube) * normals, normals


def write_ply(path: Path, points: npt.NDArray[np.float32], normals: npt.NDArray[np.float32]) -> None:
    """Write a binary PLY of points with normals."""
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + np.hstack([points, normals]).astype("<f4").tobytes())


class BatchWatcher:
    """Watches a batch from outside while its block runs; crashes the scan "killed" and stops the scan "hangs".

    Parameters
    ----------
    output : the batch's output folder
    """

    def __init__(self, output: Path) -> None:
        self._output, self._over = output, threading.Event()
        self._writings: dict[str, set[int]] = defaultdict(set)
        self._thread = threading.Thread(target=self._watch)

    def finished(self) -> list[str]:
        """Return the names of the scans that have been finished, sorted."""
        return sorted(self._writings)

    def twice(self) -> list[str]:
        """Return the names of the scans that have been finished more than once."""
        return sorted(name for name, times in self._writings.items() if len(times) > 1)

    def _watch(self) -> None:
        while not self._over.wait(0.05):
            self.look()
            for name, number in (("killed", signal.SIGSEGV), ("hangs", signal.SIGSTOP)):
                for pid in running(self._output, name):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, number)

    def look(self) -> None:
        """Note the records that exist, and when they were written."""
        for record in records_folder(self._output).glob("[a-z]*.json"):
            with contextlib.suppress(FileNotFoundError):
                self._writings[record.stem].add(record.stat().st_mtime_ns)

    def __enter__(self) -> Self:
        self.look()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        self.look()


def running(output: Path, name: str) -> list[int]:
    """Return the processes that work on a scan now."""
    found = []
    for progress in map(progress_file, running_folder(output).glob(f"{name}-*")):
        with contextlib.suppress(OSError, ValueError, KeyError):
            found.append(int(json.loads(progress.read_text(encoding="utf-8"))["pid"]))
    return found


@dataclass(frozen=True)
class Cost:
    """A command's exit code, seconds, processor seconds of all its processes, and whether it was disturbed."""

    exit_code: int
    seconds: float
    cpu_seconds: float
    disturbed: bool = False


def run_command(*words: str, disturb: Callable[[int], bool] | None = None) -> Cost:
    """Run ``gnrecon`` with arguments to its end.

    Parameters
    ----------
    disturb : called repeatedly with the process's number until it returns True
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
        disturbed = disturbed or (disturb is not None and disturb(process.pid))
        time.sleep(0.05)
    return Cost(process.returncode, time.perf_counter() - start, _children_cpu() - before, disturbed)


def _children_cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
