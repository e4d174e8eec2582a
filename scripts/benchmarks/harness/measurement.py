"""Time and memory: timed calls, and measurements in a Python process of their own.

A measurement in its own process has its own peak memory and thread count. The two sides meet in a folder: the name and
arguments of a function go in (job.json), its figures come out (figures.json).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from statistics import median
from tempfile import TemporaryFile
from time import perf_counter, process_time
from types import TracebackType
from typing import Any, Self, TypeVar

import torch

import gnrecon
from gnrecon.runtime.errors import GnreconError
from gnrecon.runtime.memory import process_peak_mb

Result = TypeVar("Result")

GNRECON = (sys.executable, "-m", "gnrecon")
"""The words of its command."""


def timed(call: Callable[[], Result], device: str = "cpu") -> tuple[float, Result]:
    """Return the seconds that a call takes, including all work that it started on the device, and its result."""
    finish(device)
    start = perf_counter()
    result = call()
    finish(device)
    return perf_counter() - start, result


def median_time(call: Callable[[], Result], repetitions: int) -> tuple[float, Result]:
    """Return the median seconds of several calls, and the result of the last."""
    runs = [timed(call) for _ in range(repetitions)]
    return median(seconds for seconds, _ in runs), runs[-1][1]


def finish(device: str) -> None:
    """Wait until the device has finished all work."""
    if device == "cuda":
        torch.cuda.synchronize()


class Stopwatch:
    """Measures a block: `seconds` of wall clock, and `cpu_seconds` of this process and its children that have ended."""

    def __enter__(self) -> Self:
        self._start, self._cpu_start = perf_counter(), _cpu_seconds()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.seconds, self.cpu_seconds = perf_counter() - self._start, _cpu_seconds() - self._cpu_start


def _cpu_seconds() -> float:
    times = os.times()
    return process_time() + times.children_user + times.children_system


def run_command(words: Sequence[str], threads: int) -> dict[str, Any]:
    """Run a command with so many threads of the numerical libraries; return its seconds and its peak memory.

    The figures are `seconds`, `cpu_seconds` and `peak_memory_mb`, that of its largest process. A failure is a result
    too: the last line that it wrote then replaces them, under ``"error"``.
    """
    with TemporaryFile("w+", encoding="utf-8") as messages:
        start = perf_counter()
        process = subprocess.Popen(words, env=_environment(threads), stdout=subprocess.DEVNULL, stderr=messages)
        _, status, used = os.wait4(process.pid, 0)
        seconds = perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            messages.seek(0)
            last = messages.read().strip().splitlines()[-1:]
            return {"error": last[0] if last else f"The process ended with status {process.returncode}."}
    return {
        "seconds": seconds,
        "cpu_seconds": used.ru_utime + used.ru_stime,
        "peak_memory_mb": used.ru_maxrss * 1024 / 1e6,
    }


class Clock:
    """Seconds since it was made, without those of its pauses."""

    def __init__(self) -> None:
        self._start = perf_counter()
        self._paused = 0.0

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return perf_counter() - self._start - self._paused

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Do not count the seconds of a block."""
        start = perf_counter()
        yield
        self._paused += perf_counter() - start


def run_isolated(
    function: str,
    arguments: Mapping[str, Any],
    folder: Path,
    *,
    threads: int | None = None,
    limit_seconds: float | None = None,
) -> dict[str, Any]:
    """Call a function with plain arguments in a new process; return its plain figures and its memory.

    `peak_memory_mb` and the part of it that the imports took, `libraries_memory_mb`, are added unless the function
    returns its own. A failure is a result too, and so is a run of more than `limit_seconds`: the sentence under
    ``"error"`` then replaces the figures.

    Parameters
    ----------
    function : ``"module:name"``
    folder : a new folder, for job.json, figures.json and what the function writes where it is given the path
    threads : of the numerical libraries, by default as many as torch uses here
    """
    module, _, name = function.partition(":")
    folder.mkdir(parents=True)
    job = {"module": module, "function": name, "arguments": dict(arguments)}
    (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
    command = [sys.executable, "-m", __name__, str(folder)]
    environment = _environment(threads or torch.get_num_threads())
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False, timeout=limit_seconds
        )
    except subprocess.TimeoutExpired:
        return {"error": f"It had not ended after {limit_seconds:g} seconds."}
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:]
        # A process that was killed (out of memory, say) has printed nothing about it.
        killed = f"The process ended with status {done.returncode}."
        return {"error": last[0] if last and done.returncode > 0 else killed}
    figures: dict[str, Any] = json.loads((folder / "figures.json").read_text(encoding="utf-8"))
    return figures


def _environment(threads: int) -> dict[str, str]:
    """Return the environment of a process with so many threads that imports this gnrecon and these benchmarks."""
    paths = [Path(__file__).resolve().parents[2], Path(str(gnrecon.__file__)).parents[1]]
    variables = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return os.environ | dict.fromkeys(variables, str(threads)) | {"PYTHONPATH": os.pathsep.join(map(str, paths))}


def main(folder: Path) -> None:
    """Do the job in `folder`, and write figures.json there."""
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    call = getattr(import_module(job["module"]), job["function"])
    before = process_peak_mb()
    figures = call(**job["arguments"])
    memory = {"peak_memory_mb": process_peak_mb(), "libraries_memory_mb": before}
    if torch.cuda.is_available():
        memory["peak_device_memory_mb"] = torch.cuda.max_memory_allocated() / 1e6
    (folder / "figures.json").write_text(json.dumps(memory | figures), encoding="utf-8")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except GnreconError as error:
        sys.exit(str(error))
