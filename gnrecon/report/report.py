"""Records the stages of a run with their times and peak memory, its resources, and the versions of the libraries."""

from __future__ import annotations

import logging
import math
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from typing import Any

import torch

from gnrecon.runtime.memory import PeakMemory, process_peak_mb
from gnrecon.runtime.parallel import worker_count
from gnrecon.version import __version__

_log = logging.getLogger(__name__)


class Stages:
    """A record of stages, in order, and of the resources that all of them took.

    Parameters
    ----------
    announce : called with a stage's name when it begins
    device : where the fit runs, ``"cpu"`` or ``"cuda"``
    """

    def __init__(self, announce: Callable[[str], None], device: str = "cpu") -> None:
        self._announce, self._device = announce, device
        self._done: list[dict[str, Any]] = []
        self._sampled = False
        self._start, self._cpu_start = time.perf_counter(), time.process_time()
        if self._on_cuda:
            torch.cuda.current_device()  # creates torch's CUDA context, which the next line needs
            torch.cuda.reset_peak_memory_stats(device)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block and watch its memory."""
        self._announce(name)
        _log.debug("Stage %s begins.", name)
        with PeakMemory() as peak:
            start, cpu_start = time.perf_counter(), time.process_time()
            yield
            seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
        self._sampled |= peak.sampled
        times = {"seconds": round(seconds, 3), "cpu_seconds": round(cpu_seconds, 3)}
        self._done.append({"name": name, **times, "peak_memory_mb": peak.mb})
        _log.info("Stage %s: %.1f s (%.1f s of processors), %.0f MB at most.", name, seconds, cpu_seconds, peak.mb)

    @property
    def _on_cuda(self) -> bool:
        return self._device.startswith("cuda")

    def as_list(self) -> list[dict[str, Any]]:
        """Return the stages as plain values."""
        return list(self._done)

    def resources(self) -> dict[str, Any]:
        """Return what the run has taken so far, as plain values."""
        cuda_peak = round(torch.cuda.max_memory_allocated(self._device) / 1e6, 1) if self._on_cuda else None
        return {
            "seconds": round(time.perf_counter() - self._start, 3),
            "cpu_seconds": round(time.process_time() - self._cpu_start, 3),
            "threads": worker_count(),
            "device": self._device,
            "device_name": torch.cuda.get_device_name(self._device) if self._on_cuda else None,
            "peak_memory_mb": process_peak_mb(),
            "stage_peaks_sampled": self._sampled,
            "cuda_peak_memory_mb": cuda_peak,
        }


def plain(value: Any) -> Any:
    """Return nested values for JSON: tuples as lists, and None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def versions() -> dict[str, str]:
    """Return the versions of gnrecon, Python and the libraries that shape the result."""
    found = {"gnrecon": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in ("numpy", "scipy", "torch", "open3d", "scikit-image", "manifold3d", "trimesh"):
        found[name] = metadata.version(name)
    return found
