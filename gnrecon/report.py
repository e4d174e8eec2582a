"""What a run says of itself: stages with their times and peak memory, and the versions that made it."""

from __future__ import annotations

import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Any

from gnrecon.version import __version__

_NAMED = ("numpy", "scipy", "torch", "open3d", "scikit-image", "manifold3d", "trimesh")


class Stages:
    """A record of stages, in order.

    Parameters
    ----------
    announce : called with a stage's name when it begins
    """

    def __init__(self, announce: Callable[[str], None]) -> None:
        self._announce = announce
        self._done: list[dict[str, Any]] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block."""
        self._announce(name)
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        self._done.append({"name": name, "seconds": round(seconds, 3), "peak_memory_mb": peak_memory_mb()})

    def as_list(self) -> list[dict[str, Any]]:
        """Return the stages as plain values; the peak is the process's, from its start to the stage's end."""
        return list(self._done)


def peak_memory_mb() -> float:
    """Return the process's greatest resident memory so far, in MB."""
    # Kilobytes on Linux, bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)


def versions() -> dict[str, str]:
    """Return the versions of gnrecon, Python and the libraries that shape the result."""
    found = {"gnrecon": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in _NAMED:
        found[name] = metadata.version(name)
    return found
